"""Mutations of bytes and of JSON-like trees: what a file may hold that a stranger, a bug or a bad disk has written.

Everything is drawn from a NumPy generator, so that a seed gives the same inputs again.
"""

import copy
import json
import math

import numpy as np

NUMBERS = (
    *(0, -0.0, 1, -1, 2, 3, 0.5, 1e-320, 1e-12, -1e-9, 1e9, 1e18, 1e200, 1e308, -1e308, math.nan, math.inf, -math.inf),
    *(255, 256, 65_536, 2**31, -(2**31), 2**53 + 1, 2**63, -(2**63) - 1, 2**64, 10**40, 10**400, -(10**400)),
)
TEXTS = (
    *(
        "",
        " ",
        "\n",
        "a\nb\r\nc",
        "\u2028x\x85y",
        "\x00",
        "a\x00b",
        "\ud800",
        "\udfffx",
        "\x1b[31mred",
        "é" * 3,
        "\U0001f600",
    ),
    *(
        "../../x",
        "/etc/passwd",
        "/dev/zero",
        "/proc/self/environ",
        "~",
        "..",
        ".",
        "C:\\x",
        "virtual",
        "none",
        "a" * 100_000,
    ),
    *("NaN", "true", "1", "-1e999", "%s%n", "{0}", "${HOME}", "[bold]", "lit\t", "\u202eabc", "A" * 5000 + "\n"),
)
BYTES = (
    *(
        b"",
        b"\x00",
        b"\xff",
        b"\xff\xfe",
        b"\xef\xbb\xbf",
        b"\n",
        b"\r",
        b"\x85",
        b"\xed\xa0\x80",
        b"\xc3",
        b'"',
        b"'",
        b"\\",
    ),
    *(
        b"{",
        b"}",
        b"[",
        b"]",
        b",",
        b":",
        b"=",
        b"#",
        b".",
        b"-",
        b"null",
        b"NaN",
        b"-Infinity",
        b"1e999",
        b"\\ud800",
        b"0x",
    ),
    *(b"9" * 5000, b"[" * 20_000, b'{"a":' * 20_000, b"x" * 70_000, b"1" + b"0" * 400, b'"""', b"[[", b"]]", b"true"),
)


def pick(rng, options):
    """One of a sequence; unlike ``Generator.choice`` it leaves the element as it is."""
    return options[int(rng.integers(len(options)))]


def hostile(rng, depth=0):
    """A value that nobody asked for: a number beside all ranges, a broken text, a container."""
    ways = (
        *(lambda: pick(rng, NUMBERS),) * 3,
        *(lambda: pick(rng, TEXTS),) * 2,
        lambda: pick(rng, (None, True, False, [], {})),
        lambda: float(rng.normal() * 10.0 ** float(rng.uniform(-20, 20))),
        lambda: deep(rng, int(pick(rng, (5, 40, 90)))),
        lambda: [hostile(rng, depth + 1) for _ in range(int(rng.integers(5)))],
        lambda: {pick(rng, TEXTS): hostile(rng, depth + 1) for _ in range(int(rng.integers(4)))},
    )
    return pick(rng, ways if depth < 3 else ways[:-2])()


def deep(rng, depth):
    """A value nested ``depth`` times in lists or tables."""
    value = pick(rng, (1, "x", None))
    for _ in range(depth):
        value = [value] if rng.random() < 0.7 else {"type": value}
    return value


def places(tree, path=()):
    """The path of every value of a tree, the root's () first."""
    found = [path]
    if isinstance(tree, dict):
        for key, value in tree.items():
            found += places(value, (*path, key))
    elif isinstance(tree, list):
        for number, value in enumerate(tree):
            found += places(value, (*path, number))
    return found


def at(tree, path):
    """The value at a path."""
    for step in path:
        tree = tree[step]
    return tree


def mutated(tree, rng, most=3):
    """A copy of ``tree`` with 1 to ``most`` of its values dropped, doubled, swapped or replaced by something hostile.

    Places are drawn so that shallow ones come as often as the many deep ones.
    """
    tree = copy.deepcopy(tree)
    for _ in range(int(rng.integers(1, most + 1))):
        every = places(tree)[1:]
        if not every:
            return hostile(rng)
        depth = pick(rng, sorted({len(path) for path in every}))
        path = pick(rng, [one for one in every if len(one) == depth])
        parent, key = at(tree, path[:-1]), path[-1]
        match int(rng.integers(9)):
            case 0:
                del parent[key]
            case 1:
                _add(parent, key, pick(rng, TEXTS), copy.deepcopy(parent[key]))
            case 2:
                _add(parent, key, pick(rng, TEXTS), hostile(rng))
            case 3:
                parent[key] = copy.deepcopy(at(tree, pick(rng, every))) if path in every else None
            case 4:
                parent[key] = retyped(parent[key])
            case 5:
                parent[key] = nudged(parent[key], rng)
            case _:
                parent[key] = hostile(rng)
    return tree


def _add(parent, key, name, value):
    if isinstance(parent, list):
        parent.insert(key, value)
    else:
        parent[name] = value


def retyped(value):
    """The same in another kind: a number as text, a text as list, a list as table."""
    if isinstance(value, bool) or value is None:
        return int(bool(value))
    if isinstance(value, (int, float)):
        return str(value)
    if isinstance(value, str):
        return [value]
    if isinstance(value, list):
        return dict(zip(map(str, range(len(value))), value, strict=True))
    return list(value.items()) and [list(pair) for pair in value.items()]


def nudged(value, rng):
    """A number scaled or turned round, a text cut, a container halved: near enough to pass the first checks."""
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        return scaled(value, pick(rng, (-1, 0, 2, 1000, 0.001, 1 + 1e-12)))
    if isinstance(value, str):
        return value[: int(rng.integers(len(value) + 1))]
    if isinstance(value, list):
        return value[: int(rng.integers(len(value) + 1))] * int(rng.integers(1, 4))
    if isinstance(value, dict):
        return {key: value[key] for key in list(value)[: int(rng.integers(len(value) + 1))]}
    return not value


def scaled(value, factor):
    """A number times a factor; as it is where that is more than a float holds."""
    try:
        return value * factor
    except OverflowError:
        return value


def mangled(data, rng, others=(), most=4):
    """``data`` with some of its bytes flipped, cut, doubled, replaced, or spliced with one of ``others``."""
    data = bytearray(data)
    for _ in range(int(rng.integers(1, most + 1))):
        start = int(rng.integers(len(data) + 1))
        end = min(len(data), start + int(rng.geometric(0.1)))
        match int(rng.integers(7)):
            case 0 if data:
                data[start % len(data)] ^= 1 << int(rng.integers(8))
            case 1:
                data = data[:start]
            case 2:
                data[start:end] = b""
            case 3:
                data[start:start] = data[start:end] * int(rng.integers(1, 5))
            case 4:
                data[start:end] = rng.bytes(end - start)
            case 5 if others:
                other = pick(rng, others)
                data = data[:start] + other[int(rng.integers(len(other) + 1)) :]
            case _:
                data[start:end] = pick(rng, BYTES)
    return bytes(data)


def to_json(tree, rng):
    """JSON of a tree, now and then with a key told twice, NaN and Infinity as Python writes them."""
    text = json.dumps(tree)
    if isinstance(tree, dict) and tree and rng.random() < 0.1:
        text = f"{text[:-1]}, {json.dumps(pick(rng, list(tree)))}: {json.dumps(hostile(rng))}}}"
    return text.encode()


def to_toml(tree):
    """TOML of a tree. What TOML has no word for (null, lone surrogates) is left as JSON has it, and is refused."""
    tree = tree if isinstance(tree, dict) else {"value": tree}
    rows = [f"{_toml(str(key))} = {_toml(value)}" for key, value in tree.items() if not _is_table(value)]
    for key, value in tree.items():
        if _is_table(value):
            rows.append(f"[{_toml(str(key))}]")
            rows += [f"{_toml(str(name))} = {_toml(inner)}" for name, inner in value.items()]
    return "\n".join(rows).encode("utf-8", errors="surrogatepass")


def _is_table(value):
    return isinstance(value, dict) and bool(value)


def _toml(value):
    if isinstance(value, dict):
        return "{" + ", ".join(f"{_toml(str(key))} = {_toml(item)}" for key, item in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(_toml, value)) + "]"
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    if isinstance(value, int) and not isinstance(value, bool):
        return hex(value) if value > 10**300 else str(value)
    return json.dumps(value, ensure_ascii=not isinstance(value, str)).replace("\x7f", "\\u007f")


def generator(seed, number):
    """The generator of the ``number``-th input of a run: any one can be made again without those before it."""
    return np.random.Generator(np.random.PCG64([seed, number]))
