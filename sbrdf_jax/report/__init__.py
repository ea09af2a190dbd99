"""Figures and a page of results. matplotlib is imported only inside the functions that draw."""

from sbrdf_jax.report.figures import draw_figures
from sbrdf_jax.report.page import write_page

__all__ = ["draw_figures", "write_page"]
