"""Ways to damage a file, at random but the same for each number."""

from __future__ import annotations

import copy
import hashlib
import io
import json
import math
import random
import struct
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock

import torch

from torchrl_her.trainers.checkpoint import load_checkpoint, save_checkpoint

MARK = b"torchrl-her checkpoint 1\n"
_BODY = len(MARK) + 32

Damage = Callable[[Path, random.Random, Path], None]  # of a file; the last is what nothing may make


# Bytes


def bits(path: Path, draw: random.Random, trap: Path) -> None:
    data = bytearray(path.read_bytes())
    for _ in range(draw.choice((1, 1, 3, 50))):
        data[draw.randrange(len(data))] ^= 1 << draw.randrange(8)
    path.write_bytes(data)


def cut(path: Path, draw: random.Random, trap: Path) -> None:
    data = path.read_bytes()
    path.write_bytes(data[: draw.randrange(len(data))])


def exchange(path: Path, draw: random.Random, trap: Path) -> None:
    """Two parts of the file trade places, or one is written twice, or over another."""
    data = path.read_bytes()
    a, b, c, d = sorted(draw.randrange(len(data)) for _ in range(4))
    parts = data[:a], data[a:b], data[b:c], data[c:d], data[d:]
    order = draw.choice(((0, 3, 2, 1, 4), (0, 1, 1, 2, 3, 4), (0, 1, 2, 1, 4), (0, 4), (0, 1, 2, 3, 4, 3)))
    path.write_bytes(b"".join(parts[i] for i in order))


# Archives of tensors


def sealed(path: Path, body: bytes) -> None:
    """Writes a body with a checksum that fits: a stranger knows how it is made."""
    path.write_bytes(MARK + hashlib.sha256(body).digest() + body)


def in_the_body(damage: Damage) -> Damage:
    """A damage of bytes behind a right checksum."""

    def do(path: Path, draw: random.Random, trap: Path) -> None:
        path.write_bytes(path.read_bytes()[_BODY:])
        damage(path, draw, trap)
        sealed(path, path.read_bytes())

    return do


def _records(path: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(path) as archive:
        found = {}
        for own in archive.infolist():
            with archive.open(own) as file:
                file._expected_crc = None  # type: ignore[attr-defined]  # checkpoints have none
                found[own.filename] = file.read()
        return found


def _pack(path: Path, records: list[tuple[str, bytes]], kind: int = zipfile.ZIP_STORED) -> None:
    file = io.BytesIO()
    with (
        mock.patch.object(zipfile, "ZIP_FILECOUNT_LIMIT", 0),  # ends as archives of torch.save do
        warnings.catch_warnings(),
        zipfile.ZipFile(file, "w", kind) as archive,
    ):
        warnings.simplefilter("ignore")  # two of the same name
        for name, data in records:
            archive.writestr(name, data)
    sealed(path, file.getvalue())


def records(path: Path, draw: random.Random, trap: Path) -> None:
    """Records trade places, are missing, are longer, are called as other files are, or are compressed."""
    found = list(_records(path).items())
    for _ in range(draw.randint(1, 3)):
        i, j = draw.randrange(len(found)), draw.randrange(len(found))
        (one, first), (other, second) = found[i], found[j]
        kind = draw.randrange(5)
        if kind == 0:
            found[i], found[j] = (one, second), (other, first)
        elif kind == 1:
            found[i] = (one, first[: draw.randrange(len(first) + 1)])
        elif kind == 2:
            found[i] = (one, first + bytes(draw.randrange(1 << 16)))
        elif kind == 3:
            found[i] = (draw.choice((f"../{one}", str(trap), f"{one}\0", one.upper())), first)
        else:
            found.insert(i, (one + "x", second))
    _pack(path, found, draw.choice((zipfile.ZIP_STORED, zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)))


def description(path: Path, draw: random.Random, trap: Path) -> None:
    """The pickle of an archive: other bytes, huge numbers, and code that leaves a file behind."""
    found = _records(path)
    (name,) = [name for name in found if name.endswith("data.pkl")]
    own = bytearray(found[name])
    for _ in range(draw.choice((1, 1, 4))):
        place = draw.randrange(2, len(own))
        kind = draw.randrange(4)
        if kind == 0:
            own[place] ^= 1 << draw.randrange(8)
        elif kind == 1:
            small = [i for i in range(len(own) - 1) if own[i] == ord("K")]  # a number of one byte
            i = draw.choice(small)
            own[i : i + 2] = b"\x8a\x06" + draw.randrange(1 << 47).to_bytes(6, "little")
        elif kind == 2:
            code = f"cos\nsystem\nX{{}}touch {trap}\x85R".encode()
            length = len(f"touch {trap}").to_bytes(4, "little")
            own[place:place] = code.replace(b"{}", length)
        else:
            own[2:2] = draw.choice((b"]q\x00h\x00", b"(" * 5_000, b"]" * 5_000, b"r\xff\xff\xff\x7f"))
    _pack(path, list({**found, name: bytes(own)}.items()))


def harmful(path: Path, draw: random.Random, trap: Path) -> None:
    """An object of somebody else's class among what is saved."""

    class Harmful:
        def __reduce__(self) -> Any:
            return draw.choice(((Path.touch, (trap,)), (eval, (f"open({str(trap)!r}, 'w')",))))

    state = load_checkpoint(path)
    state[draw.choice(list(state))] = Harmful()
    file = io.BytesIO()
    torch.save(state, file)
    sealed(path, file.getvalue())


# Policies


def _opened(path: Path) -> tuple[dict[str, Any], bytearray]:
    data = path.read_bytes()
    begin = 8 + int.from_bytes(data[:8], "little")
    return json.loads(data[8:begin]), bytearray(data[begin:])


def _close(path: Path, header: bytes, body: bytes, *, size: int | None = None) -> None:
    path.write_bytes((len(header) if size is None else size).to_bytes(8, "little") + header + body)


def header_size(path: Path, draw: random.Random, trap: Path) -> None:
    header, body = _opened(path)
    sizes = (0, 1, len(body), 1 << 22, 1 << 31, 1 << 40, (1 << 64) - 1)
    _close(path, json.dumps(header).encode(), body, size=draw.choice(sizes))


def header_text(path: Path, draw: random.Random, trap: Path) -> None:
    """Something else than JSON, or JSON of something else."""
    header, body = _opened(path)
    texts = ("", "{", "\xff", "null", "[]", "3", "[" * 5_000, '{"a":' * 5_000, "9" * 6_000, "x" * (1 << 21))
    text = draw.choice(texts)
    if draw.random() < 0.5:
        header["__metadata__"]["torchrl_her"] = text
        text = json.dumps(header)
    _close(path, text.encode("latin-1"), body)


def header_entries(path: Path, draw: random.Random, trap: Path) -> None:
    """Entries of the header, of the description in it, and what it says of tensors."""
    header, body = _opened(path)
    metadata = header["__metadata__"]
    kind = draw.randrange(3)
    if kind == 0:
        header = entries(header, draw, trap)
    elif kind == 1:
        metadata["torchrl_her"] = json.dumps(entries(json.loads(metadata["torchrl_her"]), draw, trap))
    else:
        tensor = header[draw.choice([name for name in header if name != "__metadata__"])]
        begin, end = tensor["data_offsets"]
        tensor |= draw.choice(
            (
                {"data_offsets": [end, begin]},
                {"data_offsets": [begin + 4, end + 4]},
                {"data_offsets": [begin, 1 << 40]},
                {"data_offsets": [0, end]},
                {"shape": tensor["shape"][::-1]},
                {"shape": [*tensor["shape"], 1]},
                {"shape": [1 << 62, 1 << 62]},
                {"shape": [0, 1 << 40], "data_offsets": [begin, begin]},
                *({"dtype": dtype} for dtype in ("F64", "I32", "BOOL", "C64", "F8_E4M3", "U16", "odd")),
            )
        )
    _close(path, json.dumps(header).encode(), body)


def weights(path: Path, draw: random.Random, trap: Path) -> None:
    """Numbers that are not finite."""
    header, body = _opened(path)
    for _ in range(draw.randint(1, 3)):
        place = 4 * draw.randrange(len(body) // 4)
        body[place : place + 4] = struct.pack("<f", draw.choice((math.nan, math.inf, -math.inf)))
    _close(path, json.dumps(header).encode(), body)


# Plain values


def strange(draw: random.Random, trap: Path) -> Any:
    """A value that nobody expects."""
    return draw.choice(
        (
            None,
            -1,
            0,
            1 << 62,
            10**30,
            float("nan"),
            float("inf"),
            "",
            "../../../../etc/passwd",
            str(trap),
            "a\0b",
            "\x1b[2J\nsecond line",
            "x" * 5_000,
            [],
            {},
            [[]],
            {"a": {"b": [1]}},
            True,
            "os:system",
            "gym:os:Env-v0",
            torch.Size([3]),
            (),
        )
    )


def entries(value: Any, draw: random.Random, trap: Path) -> Any:
    """The same plain value with a few entries that are missing, exchanged, or strange."""
    value = copy.deepcopy(value)
    for _ in range(draw.choice((1, 1, 2, 5))):
        places: list[tuple[Any, Any]] = []
        waiting = [value]
        while waiting:
            own = waiting.pop()
            keys = list(own) if isinstance(own, dict) else list(range(len(own)))
            places += [(own, key) for key in keys]
            waiting += [own[key] for key in keys if isinstance(own[key], dict | list)]
        if not places:
            return value
        (own, key), (other, its) = draw.choice(places), draw.choice(places)
        kind = draw.randrange(5)
        if kind == 0:
            del own[key]
        elif kind == 1:
            own[key], other[its] = copy.deepcopy(other[its]), copy.deepcopy(own[key])
        elif kind == 2 and isinstance(own[key], torch.Tensor) and own[key].numel():
            own[key] = draw.choice(
                (own[key].flatten()[1:], own[key][None], own[key].double(), own[key] * 1e30)
            )
        elif kind == 3 and isinstance(own, dict):
            own[draw.choice(("odd", "../odd", "", "a.b.c", "preset", "x" * 3_000, 7, "\x1b[2J"))] = 1
        else:
            own[key] = strange(draw, trap)
    return value


def saved_entries(path: Path, draw: random.Random, trap: Path) -> None:
    save_checkpoint(entries(load_checkpoint(path), draw, trap), path)


# Text

_BOMBS = (
    "a: &a [x, x, x, x, x, x, x, x, x]\n"
    + "".join(
        f"{b}: &{b} [{', '.join([f'*{a}'] * 9)}]\n" for a, b in zip("abcdefgh", "bcdefghi", strict=True)
    ),
    "a: &a {x: 1}\n"
    + "".join(
        f"{b}: &{b} {{<<: [*{a}, *{a}, *{a}]}}\n"
        for a, b in zip("abcdefghijklmno", "bcdefghijklmnop", strict=True)
    ),
    "a: &a [*a]\n",
    "[" * 3_000,
    "{a: " * 3_000,
    "- " * 3_000 + "x",
    "? " * 3_000 + "x",
    "seed: " + "9" * 6_000,
    "seed: 2001-99-99\n",
    "seed: !!timestamp x\n",
    "seed: !!int ''\n",
    "seed: !!bool x\n",
    "seed: !!binary x\n",
    "? [a, b]\n: 1\n",
    "? {a: b}\n: 1\n",
    "1: 2\n",
    "x" * (1 << 21),
    "\ufeff\0",
)


def bomb(path: Path, draw: random.Random, trap: Path) -> None:
    path.write_text(draw.choice(("", path.read_text())) + draw.choice(_BOMBS))


def tags(path: Path, draw: random.Random, trap: Path) -> None:
    call = draw.choice(
        (
            f"!!python/object/apply:os.system ['touch {trap}']",
            f"!!python/object/apply:pathlib.Path.touch [{trap}]",
            f"!!python/object/new:os.system ['touch {trap}']",
            "!!python/name:os.system",
            "!!python/module:os",
        )
    )
    lines = path.read_text().splitlines()
    place = draw.randrange(len(lines) + 1)
    if place < len(lines) and ":" in lines[place]:
        lines[place] = lines[place].partition(":")[0] + f": {call}"
    else:
        lines.append(f"harm: {call}")
    path.write_text("\n".join(lines))


def lines(path: Path, draw: random.Random, trap: Path) -> None:
    """Lines of a table or a configuration: missing, twice, with other words in them."""
    own = path.read_text().splitlines()
    for _ in range(draw.choice((1, 2, 4))):
        place = draw.randrange(len(own))
        words = own[place].split(",")
        kind = draw.randrange(4)
        if kind == 0:
            own.insert(place, draw.choice(own))
        elif kind == 1 and len(own) > 1:
            del own[place]
        else:
            odd = draw.choice(
                ("", "nan", "-1", "1e400", "9" * 5_000, "²", "\0", '"', "x,y", "'", "{", "\x1b[2J")
            )
            words[draw.randrange(len(words))] = odd
            own[place] = ",".join(words)
    path.write_text("\n".join(own))
