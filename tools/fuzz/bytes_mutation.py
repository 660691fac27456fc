"""Mutations of bytes, for any format."""

from __future__ import annotations

from random import Random

_CHUNKS = (
    *b"< > & ]]> <!-- --> <![CDATA[ &b; &#0; &#xD800; &#65; /> <?php?> <!DOCTYPE encoding='latin-1'".split(),
    *b'{ } [ ] " , : - \\ud800 \\u0000 1e999 NaN'.split(),
    *(b"\0", b"\xff", b"\xef\xbb\xbf", b"\xff\xfe", b"\n", b"\xed\xa0\x80", b"\xc0\x80"),
    *(
        b"<?xml version='1.1'?>",
        b"<?xml version='1.0' encoding='utf-16'?>",
        b"<!DOCTYPE a [<!ENTITY b 'c'>]>",
    ),
)
MAX_LENGTH = 60_000


def mutate(data: bytes, other: bytes, random: Random) -> bytes:
    """Exchange, insert or remove some bytes, or replace them by those of another input."""
    for _ in range(random.choice((1, 1, 2, 4))):
        at, end = sorted(random.randint(0, len(data)) for _ in range(2))
        end = min(end, at + random.choice((1, 2, 8, 64, 1000)))
        kind = random.randrange(6)
        if kind == 0:
            data = data[:at] + data[end:]
        elif kind == 1:
            data = data[:at] + random.choice(_CHUNKS) + data[at:]
        elif kind == 2:
            data = data[:at] + random.choice(_CHUNKS) + data[end:]
        elif kind == 3:
            data = data[:at] + bytes([random.randrange(256)]) + data[at + 1 :]
        elif kind == 4:
            data = data[:end] + data[at:end] * random.choice((1, 2, 20)) + data[end:]
        else:
            start = random.randint(0, len(other))
            data = data[:at] + other[start : start + end - at] + data[end:]
    return data[:MAX_LENGTH]
