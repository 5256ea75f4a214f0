"""Mutants of a file: blind bytes, and structure-aware ones that keep lengths and checksums right around a changed part.

Everything follows from the generator: a mutant is found again by its case, seed and number.
"""

from __future__ import annotations

import json
import re
import struct
from random import Random
from typing import Any

from .containers import open_container

INTEGERS = (0, 1, 2, 3, 7, 127, 128, 255, 256, 32767, 32768, 65535, 65536, 2**24, 2**31 - 1, 2**31, 2**32 - 1, 2**32,
            2**48, 2**62, 2**63 - 1, 2**63, 2**64 - 1)  # fmt: skip
FLOATS = (float("nan"), float("inf"), -float("inf"), 0.0, -0.0, 1e-45, 1e-38, 3e38, -3e38, 1e300, -1.0, 0.5)
NUMBERS = ("0", "-1", "1", "2", "nan", "inf", "-inf", "1e400", "1e39", "-1e39", "1e-400", "4294967296", "18446744073709551616",
           "9" * 400, "9" * 5000, "0x10", "1_000", "1.5", "", "x", "'", "٣", "\0")  # fmt: skip
TEXTS = ("", "..", "../../x", "/", "/dev/zero", "C:\\x", "\0", "a" * 5000, "\x1b[31m", "\ud800", "é", "NaN", "null", "__class__",
         "%s%n", "{0}", "chair", "\n", "uint64", "float32", "object", "|O", "<U9", "<f8")  # fmt: skip
DEEP = 3000  # levels of nested JSON


def mutate(data: bytes, rng: Random) -> bytes:
    """One mutant of a file."""
    for _ in range(1 if rng.random() < 0.7 else rng.randint(2, 4)):
        data = _once(data, rng)
    return data


def _once(data: bytes, rng: Random) -> bytes:
    if rng.random() < 0.65:
        try:
            changed = _structured(data, rng)
        except Exception:  # what earlier mutations left cannot be put together
            changed = None
        if changed is not None:
            return changed
    return _blind(data, rng)


def _structured(data: bytes, rng: Random, depth: int = 0) -> bytes | None:
    """A mutant of a part of the file, put back with right lengths and checksums; None if the file has no known structure."""
    container = open_container(data)
    if container is not None and depth < 3:
        parts = list(container.parts)
        roll = rng.random()
        if roll < 0.06 and len(parts) > 1:
            del parts[rng.randrange(len(parts))]
        elif roll < 0.12:
            parts.insert(rng.randrange(len(parts) + 1), rng.choice(parts))
        elif roll < 0.16:
            rng.shuffle(parts)
        elif parts:
            i = rng.randrange(len(parts))
            name, body = parts[i]
            parts[i] = (name, _structured(body, rng, depth + 1) or _blind(body, rng))
        return container.close(parts)
    if data[:1] in b"{[" and data:
        try:
            return _json(json.loads(data), rng)
        except (ValueError, RecursionError):
            return None
    try:
        text = data.decode("ascii")
    except UnicodeDecodeError:
        return None
    return _text(text, rng) if text else None


def _json(value: Any, rng: Random) -> bytes:
    """JSON with a value replaced, removed, repeated or renamed."""
    places: list[tuple[Any, Any]] = []
    rest = [value]
    while rest:
        one = rest.pop()
        for key in one if isinstance(one, dict) else range(len(one)) if isinstance(one, list) else ():
            places.append((one, key))
            rest.append(one[key])
    if not places or rng.random() < 0.03:
        return json.dumps(_strange(value, rng)).encode("utf-8", "surrogatepass")
    holder, key = rng.choice(places)
    roll = rng.random()
    if roll < 0.15:
        del holder[key]
    elif roll < 0.25 and isinstance(holder, list):
        holder += holder * rng.choice((1, 1, 9))
    elif roll < 0.25:
        holder[rng.choice(TEXTS)] = holder[key]
    elif roll < 0.35:
        holder[key] = rng.choice(places)[0] if rng.random() < 0.2 else json.loads(json.dumps(holder))
    else:
        holder[key] = _strange(holder[key], rng)
    try:
        text = json.dumps(value, ensure_ascii=rng.random() < 0.8)
    except (ValueError, RecursionError):  # it holds itself
        text = json.dumps({"a": 1})
    return text.replace('"@deep"', "[" * DEEP + "]" * DEEP).encode("utf-8", "surrogatepass")


def _strange(old: Any, rng: Random) -> Any:
    """A value in place of another: near it, or of another kind."""
    roll = rng.random()
    if isinstance(old, int | float) and not isinstance(old, bool) and roll < 0.4 and abs(old) < 1e15:
        return rng.choice([old + 1, -old, old * 1000, old / 3, int(old) + 10**6])
    if isinstance(old, str) and roll < 0.3:
        return rng.choice([old + "x", old * 50, old[:-1], old.upper()])
    if roll < 0.45:
        return rng.choice(INTEGERS) * rng.choice((1, -1))
    if roll < 0.6:
        return rng.choice(FLOATS)
    if roll < 0.8:
        return rng.choice(TEXTS)
    return rng.choice([None, True, False, [], {}, [[]], [old], {"a": old}, [old] * 3, "@deep", 10**400, [None] * 5000])


def _text(text: str, rng: Random) -> bytes:
    """Text with another number, word or line."""
    roll = rng.random()
    if roll < 0.55:
        found = list(re.finditer(r"[-+]?\d[\d.eE+-]*", text))
        if found:
            one = rng.choice(found)
            return (text[: one.start()] + rng.choice(NUMBERS) + text[one.end() :]).encode("utf-8", "surrogatepass")
    if roll < 0.75:
        words = list(re.finditer(r"[^\s,:'\"()]+", text))
        if words:
            one, other = rng.choice(words), rng.choice(words)
            new = other.group() if rng.random() < 0.5 else rng.choice(TEXTS + NUMBERS)
            return (text[: one.start()] + new + text[one.end() :]).encode("utf-8", "surrogatepass")
    lines = text.splitlines(keepends=True) or [text]
    i, j = rng.randrange(len(lines)), rng.randrange(len(lines))
    how = rng.randrange(5)
    if how == 0:
        del lines[i]
    elif how == 1:
        lines.insert(j, lines[i] * rng.choice((1, 2, 300)))
    elif how == 2:
        lines[i], lines[j] = lines[j], lines[i]
    elif how == 3:
        lines[i] = lines[i][: rng.randrange(len(lines[i]) + 1)]
    else:
        lines[i] = (
            lines[i]
            .replace(" ", rng.choice(("", "  ", "\t", "\0", ",")))
            .replace("\n", rng.choice(("\n", "\r", "\r\n")))
        )
    return "".join(lines).encode()


def _blind(data: bytes, rng: Random) -> bytes:
    """Other bytes, whatever they mean; headers, at both ends, are hit more often than values."""
    if not data:
        return bytes(rng.randrange(256) for _ in range(rng.randrange(1, 40)))
    out, n = bytearray(data), len(data)
    at = rng.randrange(n)
    if rng.random() < 0.5:
        at = rng.randrange(min(n, 96)) if rng.random() < 0.8 else n - 1 - rng.randrange(min(n, 64))
    length = min(rng.choice((1, 2, 4, 8, 16, 64, 512)), n - at)
    how = rng.randrange(10)
    if how == 0:
        for _ in range(rng.choice((1, 1, 3, 20))):
            out[rng.randrange(n)] ^= 1 << rng.randrange(8)
    elif how == 1:
        out[at : at + length] = rng.randbytes(length)
    elif how == 2:
        del out[at:]
    elif how == 3:
        del out[at : at + length]
    elif how == 4:
        out[at:at] = out[at : at + length] * rng.choice((1, 2, 50))
    elif how == 5:
        other = rng.randrange(n)
        out[at : at + length] = out[other : other + length]
    elif how == 6:
        out[at : at + length] = bytes([rng.choice((0, 255, 0x7F, 0x80))]) * length
    elif how == 7:
        out[at:at] = rng.randbytes(rng.choice((1, 2, 3, 4, 8, 100)))
    elif how == 8:
        code = rng.choice(("<f", "<d", ">f"))
        value = struct.pack(code, rng.choice([x for x in FLOATS if code == "<d" or not 3.4e38 < abs(x) < float("inf")]))
        out[at : at + len(value)] = value
    else:
        size = rng.choice((1, 2, 4, 8))
        value = rng.choice(INTEGERS) % (1 << 8 * size)
        out[at : at + size] = value.to_bytes(size, rng.choice(("little", "big")))
    return bytes(out)
