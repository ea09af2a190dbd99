"""Damage to files: bytes flipped, cut, repeated, words replaced by hostile ones, HDF5 that lies about itself."""

import h5py
import numpy as np

WORDS = (
    b"nan", b"-inf", b"1e999", b"-1e999", b"1e-320", b"9" * 400, b"0x10", b"1_000", b"", b"-0", b"1e18", b"\0",
    b"\xff\xfe", b"true", b"[", b"{", b"&a [*a]", b"!!python/object:os.system", b"../../etc/passwd",
    "\u0661\u0662".encode(), b'"', b"#", b"\r", b"99999999999999999999", b",", b",,,,", b"\n", b"null", b"%s%n",
    b"1e308", b"-1",
)  # fmt: skip
SEPARATORS = b" ,\n:\t"


def damaged(rng: np.random.Generator, content: bytes, *, is_text: bool) -> bytes:
    """Return the content after one to four random kinds of damage."""
    kinds = (flip_bits, cut, repeat_part, drop_part, set_bytes) + (replace_word,) * (3 * is_text)
    for _ in range(rng.integers(1, 5)):
        if content:
            content = kinds[rng.integers(len(kinds))](rng, content)
    return content


def flip_bits(rng, content: bytes) -> bytes:
    """Flip one to eight bits."""
    changed = bytearray(content)
    for place in rng.integers(0, len(content), rng.integers(1, 9)):
        changed[place] ^= 1 << rng.integers(8)
    return bytes(changed)


def cut(rng, content: bytes) -> bytes:
    """End early."""
    return content[: rng.integers(len(content))]


def drop_part(rng, content: bytes) -> bytes:
    """Leave a part out."""
    start = int(rng.integers(len(content)))
    return content[:start] + content[start + int(rng.integers(1, 64)) :]


def repeat_part(rng, content: bytes) -> bytes:
    """Put a part in twice."""
    start = int(rng.integers(len(content)))
    stop = start + int(rng.integers(1, 512))
    return content[:stop] + content[start:]


def set_bytes(rng, content: bytes) -> bytes:
    """Overwrite up to eight bytes by the values that sizes and offsets go wrong with."""
    start, count = int(rng.integers(len(content))), int(rng.integers(1, 9))
    byte = (b"\0", b"\xff", b"\x7f", b"\x80")[rng.integers(4)]
    return content[:start] + byte * count + content[start + count :]


def replace_word(rng, content: bytes) -> bytes:
    """Put a hostile word in the place of one."""
    edges = [k for k, byte in enumerate(content) if byte in SEPARATORS] or [0]
    place = int(rng.integers(len(edges)))
    start, stop = edges[place], edges[place + 1] if place + 1 < len(edges) else len(content)
    return content[: start + 1] + WORDS[rng.integers(len(WORDS))] + content[stop:]


def lie(rng: np.random.Generator, path) -> None:
    """Replace something in a sound HDF5 file by what it must not be: a valid file, with hostile content."""
    with h5py.File(path, "a") as file:
        items: list[str] = []
        file.visit(items.append)
        name = items[rng.integers(len(items))]
        old = file[name]
        attributes = list(file.attrs) if rng.random() < 0.3 else []
        if attributes:
            file.attrs[attributes[rng.integers(len(attributes))]] = _values(rng)
            return
        shape = old.shape if isinstance(old, h5py.Dataset) else (2, 3)
        del file[name]
        LIES[rng.integers(len(LIES))](rng, file, name, shape)


def _values(rng):
    values = (
        "",
        "x" * 30_000,
        2**63 - 1,
        -1,
        np.nan,
        "{",
        "[" * 1000,
        np.zeros((50, 50)),
        b"\xff\xfe",
        "null",
        "[1, 2]",
        True,
    )
    return values[rng.integers(len(values))]


def _huge(rng, file, name, shape):
    """A terabyte declared, nothing stored."""
    file.create_dataset(name, (2**20, 2**17)[: max(len(shape), 1)], "f8", chunks=True)


def _bomb(rng, file, name, shape):
    """Zeros, deflated a thousand times over."""
    file.create_dataset(name, data=np.zeros((2**10, 2**11)), compression="gzip", compression_opts=9)


def _wide_chunks(rng, file, name, shape):
    """A small dataset of one huge chunk."""
    shape = shape or (2,)
    limits = (None,) * len(shape)
    file.create_dataset(
        name, shape, "f8", maxshape=limits, chunks=(2**27, *(1,) * (len(shape) - 1)), compression="gzip"
    )


def _cycle(rng, file, name, shape):
    """A link to itself, or to what it lies in."""
    file[name] = h5py.SoftLink(f"/{name}") if rng.random() < 0.5 else file[name.rpartition("/")[0] or "/"]


def _outside(rng, file, name, shape):
    """Data of another file."""
    file[name] = h5py.ExternalLink("/etc/passwd", "/")


def _other_type(rng, file, name, shape):
    """Text, truth values, complex numbers, whole numbers, a compound, nothing at all."""
    kinds = (
        np.full(shape, b"text"), np.zeros(shape, bool), np.zeros(shape, complex), np.full(shape, 2**62),
        np.zeros(shape, [("a", "f8"), ("b", "i4")]), h5py.Empty("f8"),
    )  # fmt: skip
    file.create_dataset(name, data=kinds[rng.integers(len(kinds))])


def _other_shape(rng, file, name, shape):
    """An axis more, an axis less, none, or an empty one."""
    shapes = ((*shape, 2), shape[:-1], (), (0,) * len(shape), shape[::-1])
    file.create_dataset(name, data=np.ones(shapes[rng.integers(len(shapes))]))


def _odd_numbers(rng, file, name, shape):
    """What is no measured value."""
    file.create_dataset(name, data=rng.choice([np.nan, np.inf, -np.inf, -1.0, 1e308, 1e-320, 2.0**63], size=shape))


def _group(rng, file, name, shape):
    """A group in the place of a dataset, or the other way."""
    file.create_group(name)


def _absent(rng, file, name, shape):
    """Nothing."""


LIES = (_huge, _bomb, _wide_chunks, _cycle, _outside, _other_type, _other_shape, _odd_numbers, _group, _absent)
