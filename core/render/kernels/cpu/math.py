"""Scalar functions for Numba loops that LLVM turns into vector code: no library calls, no branches."""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from ....compiled import njit

# Reductions and sums may be reordered and fused, which vectorising needs; NaN and infinity keep their meaning.
FAST = {"reassoc", "contract", "arcp", "nsz"}


@intrinsic
def float_from_bits(typingctx: Any, bits: Any) -> Any:
    """The float32 with the given int32 bit pattern."""
    if bits != types.int32:
        return None

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.bitcast(args[0], ir.FloatType())

    return types.float32(types.int32), codegen


@intrinsic
def bits_of_float(typingctx: Any, value: Any) -> Any:
    """The int32 bit pattern of a float32."""
    if value != types.float32:
        return None

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.bitcast(args[0], ir.IntType(32))

    return types.int32(types.float32), codegen


@njit(inline="always")
def exp_negative(x: Any) -> Any:
    """exp(x) for float32 x ≤ 0, relative error under 3e-7·(1 + |x|); below −87 it stays at exp(−87) ≈ 1e-38.

    2ⁿ·2ᶠ with n from the exponent bits and a minimax polynomial for 2ᶠ, |f| ≤ ½. NaN gives NaN or garbage, so
    inputs are sanitised where splats are projected.
    """
    x = x if x > np.float32(-87.0) else np.float32(-87.0)
    y = x * np.float32(1.4426950408889634)
    n = np.int32(y - np.float32(0.5))
    f = y - np.float32(n)
    p = np.float32(1.326472707e-3)
    p = p * f + np.float32(9.671512649e-3)
    p = p * f + np.float32(5.550733744e-2)
    p = p * f + np.float32(2.402224209e-1)
    p = p * f + np.float32(6.931469776e-1)
    p = p * f + np.float32(1.0)
    return p * float_from_bits(np.int32((n + np.int32(127)) << np.int32(23)))


@njit(error_model="numpy", _nrt=False, forceinline=True)
def dot(a: Any, b: Any) -> Any:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(error_model="numpy", _nrt=False, forceinline=True)
def cross(a: Any, b: Any) -> Any:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
