"""The machine's own multiply-add peak, in float32 on all threads, measured rather than looked up."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from llvmlite import binding, ir
from numba import get_num_threads, njit, prange, types
from numba.core import cgutils
from numba.extending import intrinsic

# Enough to hide a latency of four or five cycles on two multiply-add units, few enough for sixteen registers.
_CHAINS = 12
_ROUNDS = 2_000_000


def lanes() -> int:
    """Numbers of float32 in the machine's widest vector register."""
    features = binding.get_host_cpu_features()
    return 16 if features.get("avx512f") else 8 if features.get("avx") else 4


_VECTOR = ir.VectorType(ir.FloatType(), lanes())


@intrinsic
def _chains(typingctx: Any, rounds: Any, factor: Any, term: Any) -> Any:
    """Sum of `_CHAINS` vectors after `rounds` of v ← v·factor + term: independent chains of multiply-adds."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        count, *scalars = args
        multiply_add = cgutils.get_or_insert_function(
            builder.module, ir.FunctionType(_VECTOR, [_VECTOR] * 3), f"llvm.fma.v{_VECTOR.count}f32"
        )
        places = [ir.Constant(ir.IntType(32), lane) for lane in range(_VECTOR.count)]
        vectors = []
        for scalar in scalars:
            vector = ir.Constant(_VECTOR, ir.Undefined)
            for place in places:
                vector = builder.insert_element(vector, scalar, place)
            vectors.append(vector)
        chains = [cgutils.alloca_once(builder, _VECTOR) for _ in range(_CHAINS)]
        for number, chain in enumerate(chains):
            builder.store(ir.Constant(_VECTOR, [float(number)] * _VECTOR.count), chain)
        with cgutils.for_range(builder, count):
            for chain in chains:
                builder.store(builder.call(multiply_add, [builder.load(chain), *vectors]), chain)
        total = ir.Constant(ir.FloatType(), 0.0)
        for chain in chains:
            for place in places:
                total = builder.fadd(total, builder.extract_element(builder.load(chain), place))
        return total

    return types.float32(types.int64, types.float32, types.float32), codegen


@njit(parallel=True)
def _run(sums: Any, rounds: Any) -> None:
    for thread in prange(sums.size):
        sums[thread] = _chains(rounds, np.float32(0.999), np.float32(0.001))


def measure_peak(rounds: int = _ROUNDS) -> float:
    """Floating-point operations a second of float32 multiply-adds (two each) on Numba's current threads.

    Args:
        rounds: of each chain; the default takes some 3 ms on a fast core.
    """
    sums = np.zeros(get_num_threads(), np.float32)
    _run(sums, 1)
    begin = time.perf_counter()
    _run(sums, rounds)
    return 2.0 * _CHAINS * lanes() * rounds * len(sums) / (time.perf_counter() - begin)
