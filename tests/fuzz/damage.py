"""Damages files: whole ones that are well become such as accidents and strangers make them, by what is in them."""

import copy
import io
import json
import re
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from random import Random
from xml.etree import ElementTree

import numpy as np
import scipy.io
import torch

from mi_ring.system.files import is_sealed, seal

NUMBERS = (
    "0",
    "-1",
    "1",
    "2",
    "0.5",
    "1e39",
    "-1e39",
    "1e300",
    "1e400",
    "1e-39",
    "1e-320",
    "nan",
    "inf",
    "-inf",
    "9" * 400,
    "2147483648",
    "-2147483649",
    "4294967295",
    "9223372036854775808",
    "0x10",
    "1_0",
    "\u0663",
    "1,5",
    "--1",
    "",
)
WORDS = (
    "",
    " ",
    "\n",
    "a\0/b",
    "..",
    "/",
    ".",
    "c" * 300,
    "$x",
    "\u00fc",
    "\u202e",
    "%s%n",
    "<script>",
    '"',
    "'",
    "&#0;",
    "nan",
    "x y",
)
VALUES = (None, True, False, -1, 0, 1, 2, 0.5, 10**400, 2**31, 2**63, -(2**63), 1e300, float("nan"), float("inf"), "",
          "x\n" * 9, "a\0/b", "c" * 300, "\ud800", [], [[1], 2], [0.0] * 16, {}, {"a": 1}, {"": {"": []}})  # fmt: skip
LARGEST = 2**20  #: bytes of what comes out


def damaged(content: bytes, name: str, random: Random) -> bytes:
    """The content of a file of this name with one to four things wrong."""
    inside = INSIDE.get(Path(name).suffix.lower(), in_bytes)
    kinds = [inside if random.random() < 0.75 else in_bytes for _ in range(random.choice((1, 1, 1, 2, 2, 3, 4)))]
    if inside is in_mat:  # once: SciPy crashes of what comes out of it
        kinds = [kind if kind is in_bytes or k == kinds.index(in_mat) else in_bytes for k, kind in enumerate(kinds)]
    for kind in sorted(kinds, key=lambda kind: kind is in_bytes):  # last: what looks inside crashes of some damage, too
        try:
            content = kind(content, random)
        except Exception:  # it is beyond what it was meant to be already
            content = in_bytes(content, random)
    return content[:LARGEST]


def in_bytes(content: bytes, random: Random) -> bytes:
    """Bits, bytes and numbers of two to eight bytes, parts that are missing, there twice, elsewhere, or cut off."""
    data = bytearray(content)
    if not data:
        return random.randbytes(random.randrange(20))
    place, other = (random.randrange(len(data)) for _ in range(2))
    if random.random() < 0.5:  # headers are where most can be wrong
        place = random.randrange(min(len(data), 256))
    size = min(random.choice((1, 2, 4, 8, 16, 64, 256)), len(data) - place)
    match random.randrange(9):
        case 0 | 1:
            data[place] ^= 1 << random.randrange(8)
        case 2:
            data[place] = random.choice((0, 1, 127, 128, 255, random.randrange(256)))
        case 3 | 4:
            code = random.choice(("<H", ">H", "<I", ">I", "<Q", ">Q", "<d", ">d", "<f"))
            if code[1] in "df":
                value = random.choice((float("nan"), float("inf"), -1.0, 0.0, 1e30, 1e-30))
            else:
                bits = 8 * struct.calcsize(code)
                value = random.choice((0, 1, 2**bits - 1, 2 ** (bits - 1), 2 ** (bits // 2), random.randrange(2**bits)))
            data[place : place + struct.calcsize(code)] = struct.pack(code, value)
        case 5:
            del data[place:]
        case 6:
            del data[place : place + size]
        case 7:
            data[other:other] = data[place : place + size]
        case 8:
            data[place : place + size] = random.randbytes(size)
    return bytes(data)


def in_text(content: bytes, random: Random) -> bytes:
    """Words that are others, swapped, missing or too many; lines that are missing, there twice, or in another order."""
    text = content.decode("utf-8")
    if random.random() < 0.3:
        lines = text.split("\n")
        place, other = (random.randrange(len(lines)) for _ in range(2))
        match random.randrange(4):
            case 0:
                del lines[place]
            case 1:
                lines.insert(other, lines[place])
            case 2:
                lines[place], lines[other] = lines[other], lines[place]
            case 3:
                lines.insert(place, random.choice(WORDS))
        return "\n".join(lines).encode(random.choice(("utf-8",) * 6 + ("utf-16", "utf-8-sig")), "replace")
    words = re.split(r"([\s,]+)", text)
    place, other = (random.randrange(len(words)) for _ in range(2))
    match random.randrange(4):
        case 0 | 1:
            words[place] = random.choice(NUMBERS + WORDS)
        case 2:
            words[place], words[other] = words[other], words[place]
        case 3:
            del words[place]
    return "".join(words).encode()


def in_tree(value: object, random: Random, surprise: Callable[[Random, object], object]) -> object:
    """Nested dictionaries and lists with one entry changed, in place, missing, called otherwise, or there twice."""
    places = [(value, key) for key in keys(value)]
    for inner, key in places:
        places += [(inner[key], own) for own in keys(inner[key])]
        if len(places) > 3000:
            break
    if not places:
        return surprise(random, value)
    inner, key = random.choice(places)
    match random.randrange(8):
        case 0:
            del inner[key]
        case 1 if isinstance(inner, dict):
            inner[random.choice(WORDS)] = inner.pop(key)
        case 1 if isinstance(inner, list):
            inner.insert(key, copy.deepcopy(inner[key]))
        case 2:
            other, there = random.choice(places)
            inner[key] = copy.deepcopy(other[there]) if there in keys(other) else None
        case 3 if isinstance(inner[key], str):
            inner[key] = random.choice(NUMBERS + WORDS)
        case 4 if isinstance(inner[key], list):
            inner[key] = inner[key] * random.choice((0, 2, 50))
        case _:
            inner[key] = surprise(random, inner[key])
    return value


def keys(value: object) -> list:
    """Of the entries of a dictionary or a list."""
    return list(value) if isinstance(value, dict) else list(range(len(value))) if isinstance(value, list) else []


def in_json(content: bytes, random: Random) -> bytes:
    if random.random() < 0.02:
        depth = random.choice((100, 3000, 100_000))
        return b"[" * depth + b"]" * random.choice((0, depth))
    changed = in_tree(json.loads(content), random, lambda random, _: copy.deepcopy(random.choice(VALUES)))
    return json.dumps(changed).encode()


def in_xml(content: bytes, random: Random) -> bytes:
    """Elements, their text and their attributes; and what only one of two parsers may read."""
    if random.random() < 0.1:
        declared = random.choice(("utf-16", "klingon", "latin-1", "utf-8"))
        entities = '<!DOCTYPE x [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;"><!ENTITY c SYSTEM "/etc/passwd">]>'
        start = random.choice(
            (f'<?xml version="1.0" encoding="{declared}"?>', entities, "<!-- -- -->", "<a/>", "\ufeff")
        )
        return start.encode() + content
    root = ElementTree.fromstring(content)
    elements = [*root.iter()]
    parents = {child: parent for parent in elements for child in parent}
    element = random.choice(elements)
    match random.randrange(8):
        case 0 if element in parents:
            parents[element].remove(element)
        case 1 if element in parents:
            parents[element].insert(0, copy.deepcopy(element))
        case 2:
            element.append(copy.deepcopy(random.choice(elements)))
        case 3:
            element.tag = random.choice([e.tag for e in elements] + ["x", "scene", "include", "default", "ref"])
        case 4:
            element.text = random.choice(NUMBERS + WORDS)
        case 5 if element.attrib:
            del element.attrib[random.choice([*element.attrib])]
        case _ if element.attrib:
            key, other = random.choice([*element.attrib]), random.choice(elements)
            numbers = element.get(key, "").split()
            if len(numbers) > 1 and random.random() < 0.5:
                numbers[random.randrange(len(numbers))] = random.choice(NUMBERS)
                element.set(key, " ".join(numbers))
            else:
                element.set(key, random.choice([*NUMBERS, *WORDS, *other.attrib.values()]))
    return ElementTree.tostring(root, "utf-8")


def surprising_array(random: Random, array: object) -> np.ndarray:
    """Another array in the place of one: of other shape, type or values."""
    array = np.array(array)
    match random.randrange(7):
        case 0:
            return array[..., :-1] if array.ndim else array[None]
        case 1:
            return array[None] if random.random() < 0.5 else array.ravel()
        case 2:
            return array.T
        case 3:
            return array.astype(random.choice(("U5", "i1", "c8", "f2", "?", "S3")))
        case 4:
            return np.array(random.choice((0, -1.0, np.nan, "x", 1e300, True)))
        case 5:
            return np.zeros(random.choice(((0,), (0, 3), (3, 0, 3), (2, 2), (1, 1, 1, 1), ())))
    array = np.array(array, copy=True)
    if array.size and array.dtype.kind in "fiu":
        array = array.astype(float)
        array.flat[random.randrange(array.size)] = random.choice(
            (np.nan, np.inf, -np.inf, 0.0, -1.0, 1e300, 1e-300, 1e39)
        )
    return array


def in_npy(content: bytes, random: Random) -> bytes:
    if random.random() < 0.3:  # the header, whose length stays as it was
        size = 10 + int.from_bytes(content[8:10], "little")
        old = content[10:size]
        shape = random.choice(("(99999999999, 17)", "(-1, 17)", "()", "(2, 'x')", "(3, 17, 0)", "(1, 1000000000)", "1"))
        kind = random.choice(("<f8", "|O", ">f8", "<U9", "<M8", "nonsense", "|V999999999"))
        new = (
            re.sub(rb"\([^)]*\)", shape.encode(), old) if random.random() < 0.5 else old.replace(b"<f8", kind.encode())
        )
        return content[:10] + new[: len(old)].ljust(len(old)) + content[size:]
    buffer = io.BytesIO()
    np.save(buffer, surprising_array(random, np.load(io.BytesIO(content))))
    return buffer.getvalue()


def in_npz(content: bytes, random: Random) -> bytes:
    arrays = in_tree(dict(np.load(io.BytesIO(content))), random, surprising_array)
    buffer = io.BytesIO()
    random.choice((np.savez, np.savez_compressed))(buffer, **{key: np.asarray(value) for key, value in arrays.items()})
    return buffer.getvalue()


def in_mat(content: bytes, random: Random) -> bytes:
    arrays = {key: value for key, value in scipy.io.loadmat(io.BytesIO(content)).items() if not key.startswith("__")}
    buffer = io.BytesIO()
    more = dict(format=random.choice(("4", "5")), do_compression=random.random() < 0.5)
    arrays = in_tree(arrays, random, surprising_array)
    scipy.io.savemat(buffer, {key: value for key, value in arrays.items() if isinstance(value, np.ndarray)}, **more)
    return buffer.getvalue()


def in_png(content: bytes, random: Random) -> bytes:
    """Chunks, whose check sums are right; enormous sizes among them."""
    place, chunks = 8, []
    while place + 12 <= len(content):
        size = int.from_bytes(content[place : place + 4], "big")
        chunks.append([content[place + 4 : place + 8], content[place + 8 : place + 8 + size]])
        place += 12 + size
    k = 0 if random.random() < 0.4 else random.randrange(len(chunks))
    match random.randrange(6):
        case 0:
            del chunks[k]
        case 1:
            chunks.insert(random.randrange(len(chunks)), list(chunks[k]))
        case 2:
            chunks[k][0] = random.choice(
                (b"PLTE", b"tRNS", b"IEND", b"IDAT", b"gAMA", b"iCCP", b"eXIf", b"acTL", b"zzzz")
            )
        case 3:
            width, height, *rest = struct.unpack(">IIBBBBB", chunks[0][1])
            sides = (0, 1, width, height, 2**16, 2**20, 2**31 - 1, 2**32 - 1)
            rest[random.randrange(5)] = random.choice((0, 1, 2, 3, 4, 6, 8, 16, 255))
            chunks[0][1] = struct.pack(">IIBBBBB", random.choice(sides), random.choice(sides), *rest)
        case _:
            chunks[k][1] = in_bytes(chunks[k][1], random)
    packed = [
        struct.pack(">I", len(own)) + kind + own + struct.pack(">I", zlib.crc32(kind + own)) for kind, own in chunks
    ]
    return content[:8] + b"".join(packed)


def surprising_tensor(random: Random, value: object) -> object:
    """Another value in the place of one in a file of torch's."""
    if isinstance(value, torch.Tensor) and random.random() < 0.7:
        value = value.clone()
        match random.randrange(5):
            case 0:
                return value[..., :-1] if value.ndim else value[None]
            case 1:
                return value.double() if random.random() < 0.5 else value.to(torch.int8)
            case 2:
                return value.ravel()
        if value.numel():
            value.view(-1)[random.randrange(value.numel())] = random.choice((float("nan"), -1.0, 0.0, 1e30)) if (
                value.is_floating_point()) else random.choice((-1, 0, 100))  # fmt: skip
        return value
    return copy.deepcopy(random.choice(VALUES))


def in_pt(content: bytes, random: Random) -> bytes:
    """Values, with the seal as it should be."""
    state = in_tree(torch.load(io.BytesIO(content), weights_only=True), random, surprising_tensor)
    buffer = io.BytesIO()
    torch.save(state, buffer)
    if is_sealed(content):
        seal(buffer)
    return buffer.getvalue()


#: What is in files, by their suffix.
INSIDE: dict[str, Callable[[bytes, Random], bytes]] = {
    ".json": in_json, ".sfm": in_json, ".xml": in_xml, ".xmp": in_xml, ".npy": in_npy, ".npz": in_npz, ".mat": in_mat,
    ".png": in_png, ".pt": in_pt, ".txt": in_text, ".csv": in_text, ".jsonl": in_text, ".obj": in_text,
}  # fmt: skip
