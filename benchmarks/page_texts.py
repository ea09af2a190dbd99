"""What the page of benchmarks says beside its tables: the title and the text of each group."""

INTRODUCTION = """\
Made by `python -m benchmarks.pages` from the records of `python -m benchmarks --suite quick|full`, each with
time and error together; errors and times are measured, none is promised. Warm seconds are the fastest of some
runs, each blocked on its result; compiling is the first run less that. MiB is the peak memory of the process."""

SECTIONS = {
    "resampling": (
        "Solvers of the bounded least squares problem",
        """\
Method `paper`'s problem, by the own solver (with the geometry's inverse, whose set-up is apart, and from
nothing: in float64, "mixed", which begins in float32 and ends in float64, and in float32 alone, which reaches
1e-4 at most) and by other packages, over tolerances or numbers of steps. The relative KKT residual is taken in
float64 of what was returned. The error against the truth stays at that of the grid once a solver has converged;
`distance` is that from the own answer at a tolerance of 1e-10. In float32 alone method `guided` is refused.""",
    ),
    "interpolation": (
        "Held-out samples",
        """\
Samples that a method did not see, over folds of a measurement. The other packages interpolate logarithms over
coordinates in which they do best. Seconds are those of a fold.""",
    ),
    "lobes": (
        "Fits of lobes",
        """\
Planted lobes of eq. 14 with a little noise, one to a lane.""",
    ),
    "representation": (
        "Compact forms",
        """\
The truth of an embedded sample on the grid, and what is left of it in a form of so many numbers for each
incident angle, everything counted.""",
    ),
    "pipeline": (
        "The whole pipeline",
        """\
From samples to the compact form, a process for each row, so that its memory and compilation are its own. One
size is swept at a time from the usual one; exponents are fitted to the largest three of each. In precision
"mixed" the bounded solvers begin in float32 and end in float64, with the same certificate.""",
    ),
    "cold start": (
        "From nothing to a result",
        """\
Wall-clock seconds of a new process that runs the quickstart without its report: without a compile cache, with
one that is still empty, with a filled one.""",
    ),
    "roofline": (
        "Roofline of the solver's step",
        """\
Operations and bytes of a step are counted from the shapes (`benchmarks/roofline.py` says how) and set beside
a large matrix product and a copy on the same machine: of an array larger than the caches (dotted) and of one
as large as the matrix (solid), which sets the share of the roof. XLA's own counts are beside them; its bytes
are those of every operation for itself, as if nothing stayed in a cache.""",
    ),
    "stability": (
        "Hostile measurements",
        """\
`python -m benchmarks.stability`: the condition number of the matrix that all wavelengths share, the worst
relative KKT residual, the error of eq. 18 in the worst wavelength and the median relative error where the
truth is known, the statuses of the wavelengths; then the solver alone on planted problems. `honest`: every
status says what its residual says. `limit`: what the tests hold the error to, where it is known how far a
sound answer may be.""",
    ),
    "fuzzing": (
        "Damaged files",
        """\
`scripts/nightly.sh` reads 100,000 damaged files by each reader (`tests/stress/test_fuzz.py`): each must end
as an answer or one clear line, within 20 s and 3 GiB. What was read last:""",
    ),
}
