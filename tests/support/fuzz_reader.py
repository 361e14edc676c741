"""Feed the reader mutated bytes: ``python -m tests.support.fuzz_reader COUNT SEED FOLDER``.

Each document is written to FOLDER before it is read, so that the last one there is the one that
a crash or a hang was on.
"""

import random
import sys
import time
from pathlib import Path

from fflin.base.errors import FflinError
from fflin.robot.urdf.reader import Urdf, describe
from tests.support.reader_corpus import CASES, REFUSE

ROBOTS = Path(__file__).parents[2] / "robots"

TOKENS = [
    *(
        b"<",
        b">",
        b"/>",
        b"</",
        b'"',
        b"'",
        b"=",
        b"&",
        b"&amp;",
        b"&#0;",
        b"&#x10FFFF;",
        b"<!--",
    ),
    *(
        b"-->",
        b"<![CDATA[",
        b"]]>",
        b"<?",
        b"?>",
        b"<!DOCTYPE",
        b"\0",
        b"\xff\xfe",
        b"\xef\xbb\xbf",
    ),
    *(
        b"\xc3",
        b"\xed\xa0\x80",
        b"\r",
        b"\n",
        b" ",
        b"nan",
        b"1e999",
        b"-",
        b"0",
        b".",
        b",",
    ),
    *(
        b"<robot>",
        b"</robot>",
        b"<link",
        b"<joint",
        b"<inertial>",
        b"</inertial>",
        b"<mimic",
    ),
    *(
        b' name="',
        b' type="',
        b' link="',
        b' xyz="',
        b' value="',
        b"fixed",
        b"planar",
        b"floating",
    ),
    *(
        b"root_joint",
        b"universe",
        b"world",
        b"base",
        b"arm",
        b"hinge",
        b'encoding="utf-16"',
    ),
]


def seeds() -> list[bytes]:
    """Small documents, right and wrong, without those for xacro, which evaluates expressions."""
    result = [path.read_bytes() for path in sorted(ROBOTS.glob("*.urdf"))]
    for case in CASES:
        document = case.document
        raw = document.encode() if isinstance(document, str) else document
        if not callable(raw) and len(raw) < 5_000 and "xacro" not in case.name:
            # The wrong ones are refused whatever is done to them.
            result.extend([raw] * (1 if case.expected == REFUSE else 10))
    return result


def mutate(document: bytes, other: bytes, rng: random.Random) -> bytes:
    """Cut, copy, splice, flip and insert a few times."""
    data = bytearray(document)
    for _ in range(rng.choice((1, 1, 1, 2, 3, 8))):
        i, j = sorted(rng.randrange(len(data) + 1) for _ in range(2))
        j = min(j, i + rng.choice((1, 4, 20, 200)))
        kind = rng.randrange(6)
        if kind == 0:
            del data[i:j]
        elif kind == 1:
            data[i:i] = data[i:j] * rng.choice((1, 2, 50))
        elif kind == 2:
            data[i:j] = rng.choice(TOKENS)
        elif kind == 3:
            data[i:i] = rng.choice(TOKENS)
        elif kind == 4 and data:
            data[rng.randrange(len(data))] = rng.randrange(256)
        else:
            k = rng.randrange(len(other) + 1)
            data[i:j] = other[k : k + rng.choice((10, 100, 1000))]
    return bytes(data)


def main(count: int, seed: int, folder: Path) -> None:
    """Run and print how many documents were read and refused."""
    rng = random.Random(seed)
    path = folder / "last.urdf"
    documents = seeds()
    counts = {True: 0, False: 0}
    while sum(counts.values()) < count:
        document = mutate(rng.choice(documents), rng.choice(documents), rng)
        if b"${" in document or b"$(" in document or b"<xacro:" in document:
            continue
        path.write_bytes(document)
        begin = time.process_time()
        try:
            accepted = isinstance(describe(document, path), Urdf)
        except FflinError as error:
            text = str(error)
            if "\n" in text or not text.startswith(f"{path}:") or len(text) > 2_000:
                raise AssertionError(
                    f"not one line that names the file: {text!r}"
                ) from error
            accepted = False
        if time.process_time() - begin > 5.0:
            raise AssertionError("it took more than 5 s of the processor")
        counts[accepted] += 1
    print(f"accepted {counts[True]}, refused {counts[False]}")


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]), Path(sys.argv[3]))
