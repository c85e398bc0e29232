"""A hash of the arithmetic of this machine: two machines with equal hashes compute the same last bits."""

from __future__ import annotations

import hashlib
import math
import platform
from functools import cache
from importlib.metadata import PackageNotFoundError, version

import numpy as np

from mjhab.core.arithmetic.sums import ordered_sum

LIBRARIES = ("mujoco", "numpy", "scipy", "numba", "trimesh")
"""Libraries whose version may change numbers that lie in the cache."""
_PROBES = 512
"""Numbers that every elementary function is tried on; two implementations differ in the last bit of some."""
_SIDE = 24
"""Rows of the matrices of the probe: too small for BLAS to use threads."""


@cache
def arithmetic_digest() -> bytes:
    """SHA-256 of what the last bits of computed numbers depend on besides code and data; part of the keys of the cache.

    It covers the versions of LIBRARIES, the kind of processor, and the bits that elementary functions and linear
    algebra give here: NumPy and BLAS choose other code on other processors (AVX-512), the C library gives sine and
    exponential. Not the version of Python, on which nothing depends.
    """
    # By their metadata: importing scipy and trimesh takes longer than all else here.
    parts = [platform.machine(), *(f"{name} {_version(name)}" for name in LIBRARIES)]
    digest = hashlib.sha256(" ".join(parts).encode())
    for result in (*_elementary(), *_linear()):
        digest.update(np.ascontiguousarray(result).tobytes())
    return digest.digest()


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return ""


def _elementary() -> list[np.ndarray]:
    """Elementary functions of NumPy, and those of the C library by way of `math`, at _PROBES numbers each."""
    steps = np.arange(1, _PROBES + 1)
    # No round numbers: at many of those all implementations agree.
    positive = steps * 0.0123456789
    angle = positive - 3.1
    # Within -1 to 1, where arcsine and arccosine are defined.
    share = angle / 3.5
    functions = (np.sin, np.cos, np.tan, np.exp, np.expm1, np.arctan, np.sinh, np.tanh)
    results = [function(angle) for function in functions]
    results += [np.log(positive), np.log2(positive), np.sqrt(positive), np.cbrt(positive)]
    results += [np.arcsin(share), np.arccos(share)]
    results += [np.arctan2(angle, positive[::-1]), np.hypot(angle, positive[::-1])]
    results += [np.power(positive, share), np.array(ordered_sum(angle))]
    # NumPy has other code for single precision, with other last bits.
    single = angle.astype(np.float32)
    results += [function(single) for function in functions]
    # MuJoCo calls those of the C library, which differ from NumPy's own.
    for function in (math.sin, math.cos, math.tan, math.exp, math.atan, math.tanh):
        results.append(np.array([function(x) for x in angle.tolist()]))
    pairs = zip(angle.tolist(), positive[::-1].tolist(), strict=True)
    rows = [(math.atan2(y, x), math.hypot(y, x), x**y) for y, x in pairs]
    return [*results, np.array(rows)]


def _linear() -> list[np.ndarray]:
    """Sums, products and decompositions of small matrices."""
    count = _SIDE * _SIDE
    # Primes, for numbers without a pattern; a random generator would be one more thing that can differ.
    wave = (np.arange(count) * 7919 % 1009 / 1009 - 0.5).reshape(_SIDE, _SIDE)
    # Positive definite, so that inverse and solution are well conditioned.
    square = wave @ wave.T + np.eye(_SIDE)
    narrow = wave.reshape(-1, 3) @ wave[:3, :3]
    results = [square, narrow, wave @ wave[0], np.dot(wave.ravel(), wave.ravel()[::-1])]
    results += [np.einsum("ij,ij->i", wave, square), wave.sum(axis=0), wave.sum()]
    results += [np.linalg.inv(square), np.linalg.solve(square, wave[0])]
    results += [np.linalg.eigvalsh(square), np.linalg.norm(wave, axis=1)]
    # Without the vectors, whose signs LAPACK may choose freely.
    results.append(np.linalg.svd(wave[:6, :6], compute_uv=False))
    return [np.asarray(result) for result in results]
