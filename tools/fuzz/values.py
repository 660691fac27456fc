"""Unusual numbers and names."""

from __future__ import annotations

from random import Random


def words(text: str) -> tuple[str, ...]:
    """Return the words of a text."""
    return tuple(text.split())


EXTREME = (
    *words(
        """
        0 -0 1 -1 0.5 3.141592653589793 -1.5707963267948966 1e-9 1e-16 1e-160 1e-300 5e-324 -5e-324 1e-400
        1e16 -1e16 1e49 1e51 1e99 1e150 -1e160 1e200 -1e307 1e308 -1e308 1.7976931348623157e308
        9007199254740993 4294967296 -2147483649
        """
    ),
    *("9" * 30, "9" * 300, "0." + "3" * 60),
)
"""Finite numbers, some of which are too large or too small."""

MALFORMED = (
    *words(
        "1e309 -1e999 nan -nan inf -inf +inf Infinity NaN 0x10 1_000 1e . - + 1,5 1;2 ٣ 1f --1 ${pi} True"
    ),
    *("", " ", "9" * 400, "1" * 1200, "\U000e0001" * 900),
)
NUMBERS = EXTREME + MALFORMED

NAMES = (
    *words(
        "/ // a/b /a a/ . .. ../x world __model__ __root__ a::b :: a:: ::a % %25 :velocity a:velocity a:5"
    ),
    *words(
        "ü [ [a] {} {0} %s a\\b ' \" < & # name None free loop closed first a/free a/x a/qw a/first a_joint"
    ),
    *words("package://p/a.stl file:///etc/passwd model://part http://x/y"),
    *("", " ", "a b", "a\tb", "\n", "\x7f", "\x85", "\u200b", "\u2028", "\u202e", "\ufffe", "$(find x)"),
    *("x" * 90, "y" * 3000, "é" * 100, "\U000e0001" * 400),
)


def number(random: Random) -> str:
    """Return the text of a number, mostly of an ordinary one."""
    chance = random.random()
    if chance < 0.92:
        return random.choice((f"{random.uniform(-2, 2):.3g}", str(random.randint(-3, 3))))
    return random.choice(EXTREME if chance < 0.99 else MALFORMED)


def numbers(random: Random, count: int) -> str:
    """Return the text of several numbers, rarely of a few more or less."""
    if random.random() < 0.01:
        count = random.choice((0, 1, count - 1, count + 1, 40))
    return " ".join(number(random) for _ in range(count))


def name(random: Random, usual: tuple[str, ...] = ("a", "b", "c", "d")) -> str:
    """Return a name, mostly a usual one."""
    return random.choice(usual if random.random() < 0.95 else NAMES)
