"""Sentences as inputs of a student: a bag of hashed words, which the first layer of the network embeds linearly."""

from __future__ import annotations

import hashlib
import re
from functools import lru_cache

import numpy as np

SENTENCE_WIDTH = 128
"""Width of an encoded sentence; checkpoints depend on it and on BUCKETS_PER_WORD."""
BUCKETS_PER_WORD = 3
"""Entries that a word raises. With one, some two of the sixty words of the built-in tasks would share it; with three
their codes are linearly independent, so that a linear layer can give each word any meaning."""
_BUCKET = np.dtype("<u2")


@lru_cache(maxsize=4096)
def encode_sentence(sentence: str) -> np.ndarray:
    """Sum of the codes of the words of a sentence, (SENTENCE_WIDTH,) float32, read-only.

    Case, punctuation, order and repetition of the words do not count. Words that no demonstration contains have codes,
    too, but the network has learned nothing about them.
    """
    code = np.zeros(SENTENCE_WIDTH, np.float32)
    for word in set(re.findall(r"\w+", sentence.lower())):
        # Two buckets of a word may be the same, which += would count once.
        np.add.at(code, _buckets(word), 1.0)
    # The cache hands out the same array again.
    code.setflags(write=False)
    return code


def _buckets(word: str) -> np.ndarray:
    """Entries of a word, (BUCKETS_PER_WORD,), the same on every machine and in every version."""
    # Not hash(): Python salts it anew in every process.
    digest = hashlib.blake2b(
        word.encode(), digest_size=BUCKETS_PER_WORD * _BUCKET.itemsize
    ).digest()
    return np.frombuffer(digest, _BUCKET) % SENTENCE_WIDTH
