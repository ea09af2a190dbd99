"""Benchmarks, run by hand; a record holds run time and error together, and none asserts a speed."""
