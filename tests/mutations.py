"""Mutations of valid files, seeded: what a damaged disk, a broken program or a stranger makes of them.

``mutate(path, random, outside)`` changes one file in a way that suits its kind. All else are functions from bytes to
bytes, or from a value to a value.
"""

from __future__ import annotations

import ast
import copy
import io
import json
import math
import os
import pickle
import struct
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import torch
import yaml

Mutation = Callable[[bytes, Random], bytes]


class Payload:
    """Runs code when it is unpickled: it makes a file."""

    def __init__(self, path: Path | str):
        self.path = Path(path)

    def __reduce__(self):
        return (Path.touch, (self.path,))


TRACE = "payload-was-run"
"""The file that :class:`Payload` makes, in the working directory."""


# Any file.


def truncated(data: bytes, random: Random) -> bytes:
    return data[: random.randrange(len(data) + 1)]


def emptied(data: bytes, random: Random) -> bytes:
    return b""


def flipped(data: bytes, random: Random) -> bytes:
    changed = bytearray(data)
    for _ in range(random.randint(1, 8) if data else 0):
        changed[random.randrange(len(data))] ^= 1 << random.randrange(8)
    return bytes(changed)


def overwritten(data: bytes, random: Random) -> bytes:
    start, length = random.randrange(len(data) + 1), random.choice((1, 4, 8, 64, 1024))
    fill = random.choice((b"\0", b"\xff", b"A"))
    piece = random.randbytes(length) if random.random() < 0.3 else fill * length
    return data[:start] + piece + data[start + length :]


def spliced(data: bytes, random: Random) -> bytes:
    at, start, end = (random.randrange(len(data) + 1) for _ in range(3))
    return data[:at] + data[min(start, end) : max(start, end)] + data[at:]


def doubled(data: bytes, random: Random) -> bytes:
    return data + data


def random_bytes(data: bytes, random: Random) -> bytes:
    return random.randbytes(random.choice((1, 16, 300, 5000)))


def huge_number(data: bytes, random: Random) -> bytes:
    """A field of 1, 2, 4 or 8 bytes becomes extreme: a count, an offset, a size."""
    size = random.choice((1, 2, 4, 8))
    places = max(1, len(data) // size)
    at = 0 if random.random() < 0.2 else size * random.randrange(places)
    order = random.choice(("little", "big"))
    value = random.choice((0, 1, 2**31 - 1, 2**32 - 1, 2**40, 2**63 - 1, 2**64 - 1, 10**9)) % 2 ** (8 * size)
    return data[:at] + value.to_bytes(size, order) + data[at + size :]


def pickled(data: bytes, random: Random) -> bytes:
    return pickle.dumps(Payload(TRACE))


BYTES = (truncated, emptied, flipped, overwritten, spliced, doubled, random_bytes, huge_number, pickled)


# Text.


def with_bom(data: bytes, random: Random) -> bytes:
    return b"\xef\xbb\xbf" + data


def recoded(data: bytes, random: Random) -> bytes:
    encoding = random.choice(("utf-16", "utf-32", "utf-7", "cp1252", "utf-16-be"))
    return data.decode("utf-8", "replace").encode(encoding, "replace")


def nested(data: bytes, random: Random) -> bytes:
    depth = random.choice((100, 900, 5000, 100_000))
    opening, closing = random.choice(((b"[", b"]"), (b'{"a":', b"}")))
    inside = opening * depth + b"1" + closing * depth
    if random.random() < 0.5:
        return inside
    at = data.find(b":", random.randrange(len(data) + 1)) + 1
    return data[:at] + inside + data[at:]


def key_twice(data: bytes, random: Random) -> bytes:
    lines = data.splitlines(keepends=True)
    line = random.randrange(len(lines)) if lines else 0
    return b"".join([*lines[: line + 1], *lines[line:]])


NUMBERS = (0, -1, 1, 2, 1.5, -0.0, 1e-300, 1e39, 1e300, 10**9, 2**31, 2**63, 2**64, 10**400, 99_999_999)
STRINGS = (
    "", " ", "x", "0", "1/0", "nan", "x" * 100_000, "..", "../../etc/passwd", "/etc/passwd", "~", "~root/x", "a\0b",
    "\ud800", "C:\\x", "\n", "\x1b[31m", "${oc.env:HOME}", "${oc.decode:'1+1'}", "${seed}", "${", "???", "os.system",
    "os:system", "<script>alert(1)</script>", "../../../outside", "images", "%s%n{0}{x.__class__}", "1e400", "٣",
)  # fmt: skip


EMPTY = ([], {}, [[]], [{}], {"": None}, [None] * 5, [1, 2, 3], ["a", "b"], [0] * 10_000)


def odd_value(random: Random) -> Any:
    """Something that hardly any key expects."""
    deep: Any = 1
    for _ in range(random.choice((3, 50, 300))):
        deep = [deep] if random.random() < 0.5 else {"a": deep}
    strange = {random.choice(("_target_", "name", "a", "")): random.choice(("os.system", 1, None)), "_args_": ["exit"]}
    kinds = NUMBERS, STRINGS, (math.nan, math.inf, -math.inf), (None, True, False), EMPTY, (strange,), (deep,)
    return random.choice(random.choice(kinds))


def places(value: Any, path: tuple = ()) -> list[tuple]:
    """Paths of all values inside ``value``, itself left out."""
    children = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [path] * bool(path) + [found for key, child in children for found in places(child, (*path, key))]


def at(value: Any, path: tuple) -> Any:
    """What lies there; ``None`` where nothing does any more."""
    for key in path:
        try:
            value = value[key]
        except (KeyError, IndexError, TypeError):
            return None
    return value


def changed_tree(value: Any, random: Random) -> Any:
    """A nest of dicts and lists with one to three things in it dropped, replaced, repeated, renamed or exchanged."""
    value = copy.deepcopy(value)
    for _ in range(random.randint(1, 3)):
        found = places(value)
        if not found:
            return odd_value(random)
        # One list of numbers holds more places than all keys: each depth is as likely.
        depth = random.choice(sorted({len(path) for path in found}))
        *parents, last = random.choice([path for path in found if len(path) == depth])
        owner, kind = at(value, parents), random.randrange(6)
        if kind == 0:
            del owner[last]
        elif kind == 1 and isinstance(owner, list):
            owner.insert(last, copy.deepcopy(owner[last]))
        elif kind == 2 and isinstance(owner, dict):
            owner[random.choice((*STRINGS[:5], f"{last}x", "_target_"))] = owner.pop(last)
        elif kind == 3:
            owner[last] = copy.deepcopy(at(value, random.choice(found)))
        elif kind == 4 and isinstance(owner[last], int | float) and not isinstance(owner[last], bool):
            number = owner[last]
            whole = int(number) if math.isfinite(number) else 0
            owner[last] = random.choice((-number, number * 1e6, str(number), whole, NUMBERS[-1]))
        else:
            owner[last] = odd_value(random)
    return value


def json_tree(data: bytes, random: Random) -> bytes:
    text = json.dumps(changed_tree(json.loads(data), random))
    return (text.replace("NaN", "1e400") if random.random() < 0.2 else text).encode("utf-8", "surrogatepass")


def json_key_twice(data: bytes, random: Random) -> bytes:
    """A key of the object, or of the first object of a list, a second time."""
    content = json.loads(data)
    if isinstance(content, list):
        return b"[" + json_key_twice(json.dumps(content[0]).encode(), random) + b"]"
    key, value = random.choice(list(content.items()))
    extra = json.dumps({key: random.choice((odd_value(random), value))}).encode("utf-8", "surrogatepass")
    return data.rstrip()[:-1] + b"," + extra[1:]


def yaml_tree(data: bytes, random: Random) -> bytes:
    value = changed_tree(yaml.safe_load(data), random)
    text = yaml.safe_dump(value, sort_keys=False) if random.random() < 0.8 else json.dumps(value)
    return text.encode("utf-8", "surrogatepass")


def put(file: Path, key: str, value: object) -> None:
    """Change a value of a YAML file, of a dotted key, as a text editor would."""
    content = yaml.safe_load(file.read_text())
    *parents, last = key.split(".")
    at(content, parents)[last] = value
    file.write_text(yaml.safe_dump(content))


def yaml_text(data: bytes, random: Random) -> bytes:
    """What YAML has beyond plain values, put in the place of one of them, or on top."""
    odd = random.choice(
        (
            "!!python/object/apply:os.system ['touch payload-was-run']", "!!python/name:os.system",
            "!!python/object/new:os.system ['touch payload-was-run']", "!!python/module:os", "!!binary aGVsbG8=",
            "!!set {a, b}", "!!omap [a: 1]", "!!timestamp 2001-99-99", "2001-01-01", "2001-99-99", "&a [*a]",
            "&a {b: *a}",
            "*missing", "1:30:59", "0o17", "0b11", "<<: 1", "!!int abc", "!!float abc", "!!null x", "1" * 5000, "? [a]",
            "${oc.env:HOME}", "${oc.decode:'[1]'}", "${now:%Y}", "{[1]: 2}", "{1: 2}", "{null: 2}", "|\n  text", "@x",
            "%x", "\t- x", "!unknown x", "???", ".nan", ".inf", "~",
        )
    )  # fmt: skip
    lines = data.decode().splitlines()
    at = random.randrange(len(lines))
    lines[at] = f"{lines[at].partition(':')[0]}: {odd}"
    return "\n".join(lines).encode()


# Pictures.


def png_chunks(data: bytes) -> list[tuple[bytes, bytes]]:
    """Names and bodies of a PNG's chunks."""
    found, at = [], 8
    while at + 8 <= len(data):
        (length,) = struct.unpack_from(">I", data, at)
        found.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + length]))
        at += 12 + length
    return found


def png_of(chunks: list[tuple[bytes, bytes]]) -> bytes:
    """A PNG whose check sums are right."""
    parts = (
        struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body)) for name, body in chunks
    )
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


SIDES = (0, 1, 7, 9, 4000, 8193, 12_500, 20_000, 65_535, 100_000, 2**30, 2**31 - 1, 2**32 - 1)


def png_header(data: bytes, random: Random) -> bytes:
    """Another size, bit depth, kind or interlacing than the pixels have, the check sum right."""
    (name, body), *rest = png_chunks(data)
    width, height, *kinds = struct.unpack(">IIBBBBB", body)
    which = random.randrange(4)
    if which == 0:
        width = random.choice(SIDES)
    elif which == 1:
        width = height = random.choice(SIDES)
    elif which == 2:
        kinds[:2] = random.choice((1, 2, 4, 8, 16, 32)), random.choice((0, 2, 3, 4, 6, 7))
    else:
        kinds[random.randrange(5)] = random.randrange(256)
    return png_of([(name, struct.pack(">IIBBBBB", width, height, *kinds)), *rest])


def png_body(data: bytes, random: Random) -> bytes:
    """A chunk dropped, repeated, moved, emptied or put in; texts and profiles that are small only when packed."""
    chunks, kind = png_chunks(data), random.randrange(6)
    place, anywhere = random.randrange(len(chunks)), random.randrange(1, len(chunks) + 1)
    bomb = b"a\0\0" + zlib.compress(bytes(50_000_000))
    odd = random.choice((b"PLTE", b"tRNS", b"acTL", b"fcTL", b"fdAT", b"gAMA", b"sBIT", b"pHYs", b"abcd"))
    name, body = chunks[place]
    if kind == 0:
        del chunks[place]
    elif kind == 1:
        chunks.insert(place, chunks[place])
    elif kind == 2:
        chunks.append(chunks.pop(place))
    elif kind == 3:
        chunks[place] = (name, random.randbytes(len(body)))
    elif kind == 4:
        chunks.insert(1, random.choice(((b"zTXt", bomb), (b"iCCP", bomb), (b"eXIf", b"MM\0*" + bytes(9)))))
    else:
        chunks.insert(anywhere, (odd, random.randbytes(random.choice((0, 1, 4, 8, 26, 800)))))
    return png_of(chunks)


def png_bomb(data: bytes, random: Random) -> bytes:
    """A whole picture of a few hundred kilobytes that is far larger when it is unpacked."""
    side, bits = random.choice(((4000, 8), (20_000, 1)))
    row = b"\0" + bytes(side * bits // 8)
    packer = zlib.compressobj(1)
    body = b"".join([*(packer.compress(row) for _ in range(side)), packer.flush()])
    header = struct.pack(">IIBBBBB", side, side, bits, 0, 0, 0, 0)
    return png_of([(b"IHDR", header), (b"IDAT", body), (b"IEND", b"")])


def jpeg_header(data: bytes, random: Random) -> bytes:
    """Another size in the frame's header, or another marker."""
    for marker in range(0xC0, 0xC4):
        at = data.find(bytes([0xFF, marker]))
        if at > 0:
            height, width = random.choice(SIDES) % 65_536, random.choice(SIDES) % 65_536
            return data[: at + 5] + struct.pack(">HH", height, width) + data[at + 9 :]
    return flipped(data, random)


def webp_header(data: bytes, random: Random) -> bytes:
    """Another size in the frame's or canvas' header."""
    side = random.choice((0, 1, 8193, 12_500, 16_383))
    start = {b"VP8X": 24, b"VP8 ": 26}.get(data[12:16], 21)
    return (
        data[:start]
        + random.choice((struct.pack("<HH", side, side), struct.pack("<I", side | side << 14)))
        + data[start + 4 :]
    )


def tiff_entry(data: bytes, random: Random) -> bytes:
    """A directory entry's tag, kind, count or value becomes extreme: widths, strips, offsets, levels, matrices."""
    (start,) = struct.unpack_from("<I", data, 4)
    (count,) = struct.unpack_from("<H", data, start)
    at = start + 2 + 12 * random.randrange(count)
    tag, kind, number, value = struct.unpack_from("<HHII", data, at)
    odd = random.choice((0, 1, 2, 65_535, 100_000, 2**24, 2**31 - 1, 2**32 - 1, len(data), len(data) - 1))
    which = random.randrange(5)
    if which == 0:
        tag = random.choice((tag ^ 1, 330, 34665, 34853, 50740, 34675, 37500))
    elif which == 1:
        kind = random.randrange(15)
    elif which == 2:
        number = odd
    else:
        value = odd
    return data[:at] + struct.pack("<HHII", tag, kind, number, value) + data[at + 12 :]


# Arrays and archives.


def npy_header(data: bytes, random: Random) -> bytes:
    """Another shape, kind or order than the numbers have."""
    length = struct.unpack_from("<H", data, 8)[0]
    header = ast.literal_eval(data[10 : 10 + length].decode("latin-1"))
    shape = header["shape"]
    odd = (
        ("shape", (10**12,) * len(shape)), ("shape", (2**63, 2**63)), ("shape", (-1, -1)), ("shape", ()),
        ("shape", (0, 17)), ("shape", shape[::-1]), ("shape", shape[:1]), ("shape", "x"), ("shape", (10**400,)),
        ("shape", (1.5, 2)),
        ("descr", "|O"), ("descr", "<i8"), ("descr", "<c16"), ("descr", "<U99999999"), ("descr", "<M8[s]"),
        ("descr", "|V8"), ("descr", ">f8"), ("descr", "<f2"), ("descr", [("a", "|O")]), ("descr", "nonsense"),
        ("descr", "<f16"),
        ("fortran_order", True), ("fortran_order", "x"), ("more", 1),
    )  # fmt: skip
    key, value = random.choice(odd)
    text = repr({**header, key: value}).encode()
    text += b" " * (-(10 + len(text) + 1) % 64) + b"\n"
    return data[:8] + struct.pack("<H", len(text)) + text + data[10 + length :]


def npy_values(data: bytes, random: Random) -> bytes:
    """One number out of the range of all, or the array as Python objects."""
    array = np.load(io.BytesIO(data))
    out = io.BytesIO()
    if random.random() < 0.2:
        objects = array.astype(object)
        objects.flat[0] = Payload(TRACE)
        np.save(out, objects, allow_pickle=True)
    else:
        array = array.copy()
        with np.errstate(over="ignore"):
            array.flat[random.randrange(array.size)] = random.choice((np.nan, np.inf, 0, -1, 1e300, 1e-300, 1e6))
        np.save(out, array)
    return out.getvalue()


BOMB = 2**30 + 2**28
"""Bytes of an archive's entry when it is unpacked; packed it has a few megabytes."""


def zip_entries(data: bytes, random: Random) -> bytes:
    """An entry of an archive left out, repeated, damaged with the right check sum, packed, or far larger unpacked."""
    out = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as old, zipfile.ZipFile(out, "w", compresslevel=1) as new:
        names = old.namelist()
        chosen, kind = random.choice(names), random.randrange(6)
        for name in names:
            content, how = old.read(name), zipfile.ZIP_STORED
            if name == chosen:
                if kind == 0:
                    continue
                if kind == 1:
                    new.writestr(f"../{name}", content)
                if kind == 2:
                    content = random.choice(BYTES)(content, random)
                if kind == 3:
                    how = zipfile.ZIP_DEFLATED
                if kind == 4:
                    content, how = bytes(BOMB), zipfile.ZIP_DEFLATED
                if kind == 5 and name.endswith("data.pkl"):
                    content = random.choice((pickled, flipped, overwritten))(content, random)
            new.writestr(name, content, how)
    return out.getvalue()


def torch_tree(data: bytes, random: Random) -> bytes:
    """A checkpoint of other things: keys dropped, tensors of other shapes, kinds, or that claim to be huge."""
    content = torch.load(io.BytesIO(data), weights_only=True)
    found = places(content)
    *parents, last = random.choice([path for path in found if len(path) == random.choice((1, 2, 2, 3))] or found)
    owner = at(content, parents)
    odd = (
        torch.zeros(1), torch.full((3, 3), float("nan")), torch.zeros(1).expand(2**40), torch.zeros(0),
        torch.sparse_coo_tensor([[0]], [1.0], (2**40,), check_invariants=True), torch.tensor(1j),
        torch.zeros(2, dtype=torch.int64),
        [-1, 0, 1], [10**5] * 3,
    )  # fmt: skip
    kind = random.randrange(4)
    if kind == 0:
        del owner[last]
    elif kind == 1 and isinstance(owner[last], torch.Tensor):
        owner[last] = owner[last][None] if random.random() < 0.5 else owner[last] * float("nan")
    else:
        owner[last] = random.choice(odd) if kind == 2 else odd_value(random)
    out = io.BytesIO()
    torch.save(content, out)
    return out.getvalue()


TEXT = (with_bom, recoded, nested, key_twice)
OF_KIND: dict[str, tuple[Mutation, ...]] = {
    ".json": (json_tree, json_tree, json_tree, json_tree, json_key_twice, *TEXT),
    ".yaml": (yaml_tree, yaml_tree, yaml_tree, yaml_text, yaml_text, *TEXT),
    ".png": (png_header, png_header, png_body, png_bomb),
    ".jpg": (jpeg_header,),
    ".webp": (webp_header,),
    ".tif": (tiff_entry,),
    ".dng": (tiff_entry,),
    ".npy": (npy_header, npy_values),
    ".npz": (zip_entries,),
    ".ckpt": (zip_entries, torch_tree, torch_tree),
    ".pth": (zip_entries, torch_tree),
    ".bin": (huge_number, overwritten),
}
"""Mutations that know a kind of file, by its ending."""


# What is no file.


def replaced(path: Path, random: Random, outside: Path) -> str:
    """The file goes, and something else takes its place, perhaps a link to a copy in the folder ``outside``."""
    kept = outside / path.name
    kept.write_bytes(path.read_bytes())
    other = random.choice(sorted(each for each in path.parent.iterdir() if each.suffix == path.suffix))
    other = other.read_bytes() if other.is_file() and not other.is_symlink() else b""
    kinds: dict[str, Callable[[], object]] = {
        "nothing": lambda: None,
        "folder": path.mkdir,
        "link out": lambda: path.symlink_to(kept),
        "link to itself": lambda: path.symlink_to(path.name),
        "link to nothing": lambda: path.symlink_to("nowhere"),
        "pipe": lambda: os.mkfifo(path),
        "device": lambda: path.symlink_to("/dev/zero"),
        "other": lambda: path.write_bytes(other),
    }
    kind = random.choice([*kinds])
    path.unlink()
    kinds[kind]()
    return kind


def mutate(path: Path, random: Random, outside: Path) -> str:
    """Change a file, which may have hard links elsewhere that stay as they are; what was done to it."""
    if random.random() < 0.12:
        return replaced(path, random, outside)
    known = OF_KIND.get(path.suffix, ())
    mutation = random.choice(known if known and random.random() < 0.7 else BYTES)
    data = mutation(path.read_bytes(), random)
    path.unlink()
    path.write_bytes(data)
    return mutation.__name__
