"""Damage to the bytes of a file."""

import numpy as np


def mutated(content: bytes, header: int, rng: np.random.Generator) -> bytes:
    """Bytes changed, cut out, doubled or cut off, most of them where the file says what is where."""
    new = bytearray(content)
    for _ in range(rng.integers(1, 6)):
        end = min(header, len(new)) if rng.random() < 0.7 else len(new)
        at = int(rng.integers(0, max(end, 1)))
        num = int(rng.integers(1, 9))
        match rng.integers(0, 5):
            case 0 | 1:
                new[at : at + num] = rng.integers(0, 256, num).astype(np.uint8).tobytes()
            case 2:
                del new[at : at + num]
            case 3:
                new[at:at] = new[at : at + num]
            case _:
                del new[int(rng.integers(0, len(new) + 1)) :]
    return bytes(new)
