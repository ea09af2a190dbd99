"""Error against time, drawn from records: python -m benchmarks.plots FILE.jsonl --output FOLDER."""

import argparse
from pathlib import Path

from benchmarks.records import Record, read_lines
from benchmarks.tables import unique


def draw(records: list[Record], folder: str | Path) -> list[Path]:
    """Draw a picture for every group, a panel for each of its problems; return the pictures."""
    import matplotlib.pyplot as plt

    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for group in unique(record.group for record in records):
        some = [record for record in records if record.group == group]
        problems = unique(record.problem for record in some)
        size = (5.5 * len(problems), 4.2)
        figure, panels = plt.subplots(1, len(problems), figsize=size, squeeze=False, layout="constrained")
        for axes, problem in zip(panels[0], problems, strict=True):
            of_problem = [record for record in some if record.problem == problem]
            for method, marker in zip(unique(r.method for r in of_problem), "os^Dvx*P<>hp1234" * 4, strict=False):
                line = sorted((r.seconds_min, _height(r)) for r in of_problem if r.method == method)
                axes.loglog(*zip(*line, strict=True), marker=marker, markersize=4, linewidth=1, label=method)
            axes.set_xlabel("seconds, warm")
            is_solver = of_problem[0].kkt_residual is not None
            axes.set_ylabel("relative KKT residual" if is_solver else of_problem[0].error_kind)
            axes.set_title(problem)
            axes.grid(True, which="major", alpha=0.3)
            axes.legend(fontsize=7)
        paths.append(folder / f"{group}.png")
        figure.savefig(paths[-1], dpi=120)
        plt.close(figure)
    return paths


def _height(record: Record) -> float:
    """What is drawn: the residual of a solver, because its error is mostly that of the grid."""
    return record.error if record.kkt_residual is None else record.kkt_residual


def main() -> None:
    """Draw the records of a file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("records", help="a file that python -m benchmarks --output has written")
    parser.add_argument("--output", default="results/benchmarks", help="folder of the pictures")
    args = parser.parse_args()
    for path in draw(read_lines(args.records), args.output):
        print(path)


if __name__ == "__main__":
    main()
