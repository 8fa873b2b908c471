"""Vector operations on rows of 16 floats for the hot loops. numba has none of them; each is a few LLVM instructions.

A row is 16 float32 = 64 bytes: one cache line, and one vector register of AVX-512 (on other processors LLVM splits it).
All arrays are one-dimensional float32 whose rows begin at multiples of 64 bytes; `corners` holds the offsets of 8 rows.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.core import config
from numba.extending import intrinsic as _intrinsic

from nerf_core.common.jit.cache import cache_folder

# numba reads the environment only when it is imported, and it may be imported already
config.CACHE_DIR = cache_folder()  # pyright: ignore[reportAttributeAccessIssue]  set there by name
# Fast mathematics without the promise that nothing is infinite or NaN. With that promise the compiler would drop the
# checks for such values, and a damaged ray would index a cell outside the grid.
NEARLY_EXACT = {"nsz", "arcp", "contract", "afn", "reassoc"}
FAST = ("fast",)  # sums may be reordered and contracted to fused multiply-adds
_FLOAT, _I8, _I32, _I64 = ir.FloatType(), ir.IntType(8), ir.IntType(32), ir.IntType(64)
_ROW = ir.VectorType(_FLOAT, 16)


def jit(function: Any) -> Any:
    """Compile a function with numba: cached on disk, without the GIL, and without a check for division by zero."""
    return njit(nogil=True, cache=True, fastmath=NEARLY_EXACT, error_model="numpy")(function)


def inlined(function: Any) -> Any:
    """Compile a function like `jit`, into its callers: a call with many arrays takes as long as a sample."""
    return njit(nogil=True, cache=True, fastmath=NEARLY_EXACT, error_model="numpy", forceinline=True)(function)


def intrinsic(function: Any) -> Any:
    """Define a function of LLVM instructions. Callers leave out its first argument, which is numba's typing context."""
    return _intrinsic(function)


def _pointer(context: Any, builder: Any, kind: Any, array: Any, offset: Any = None) -> Any:
    data = context.make_array(kind)(context, builder, array).data
    return data if offset is None else builder.gep(data, [offset])


def _load(builder: Any, pointer: Any) -> Any:
    return builder.load(builder.bitcast(pointer, _ROW.as_pointer()), align=64)


def _store(builder: Any, value: Any, pointer: Any) -> None:
    builder.store(value, builder.bitcast(pointer, _ROW.as_pointer()), align=64)


def _splat(builder: Any, value: Any) -> Any:
    empty = ir.Constant(_ROW, ir.Undefined)
    one = builder.insert_element(empty, value, ir.Constant(_I32, 0))
    return builder.shuffle_vector(one, empty, ir.Constant(ir.VectorType(_I32, 16), [0] * 16))


def _item(builder: Any, pointer: Any, k: int) -> Any:
    return builder.load(builder.gep(pointer, [ir.Constant(_I64, k)]))


def _gathered(context: Any, builder: Any, kinds: Any, args: Any) -> Any:
    source = _pointer(context, builder, kinds[0], args[0])
    offsets = _pointer(context, builder, kinds[1], args[1], args[3])
    factors = _pointer(context, builder, kinds[2], args[2], args[3])
    total = None
    for k in range(8):
        row = _load(builder, builder.gep(source, [_item(builder, offsets, k)]))
        part = builder.fmul(_splat(builder, _item(builder, factors, k)), row, flags=FAST)
        total = part if total is None else builder.fadd(total, part, flags=FAST)
    return total


@intrinsic
def gather(typing: Any, out: Any, at: Any, rows: Any, corners: Any, weights: Any, first: Any) -> Any:
    """out[at : at + 16] = Σ_k weights[first + k] · rows[corners[first + k] : + 16], k < 8."""
    signature = types.void(out, types.int64, rows, corners, weights, types.int64)

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        kinds = signature.args
        total = _gathered(context, builder, kinds[2:6], args[2:6])
        _store(builder, total, _pointer(context, builder, kinds[0], args[0], args[1]))
        return context.get_dummy_value()

    return signature, emit


@intrinsic
def gather_dots(
    typing: Any, out: Any, at: Any, rows: Any, corners: Any, weights: Any, first: Any, factors: Any, begin: Any,
    alone: Any,
) -> Any:  # fmt: skip
    """out[at + i] = Σ_c f[begin + c] · row[c], 4 i ≤ c < 4 i + 4; row of `gather`, f = factors.

    And out[alone] = row[12].
    """
    long = types.int64
    signature = types.void(out, long, rows, corners, weights, long, factors, long, long)

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        kinds = signature.args
        total = _gathered(context, builder, kinds[2:6], args[2:6])
        density = builder.extract_element(total, ir.Constant(_I32, 12))
        builder.store(density, _pointer(context, builder, kinds[0], args[0], args[8]))
        by = _pointer(context, builder, kinds[6], args[6], args[7])
        total = builder.fmul(total, _load(builder, by), flags=FAST)
        for _ in range(2):  # sums of pairs, twice
            half = total.type.count // 2
            kind = ir.VectorType(_I32, half)
            even, odd = (
                builder.shuffle_vector(total, total, ir.Constant(kind, [2 * c + k for c in range(half)]))
                for k in (0, 1)
            )
            total = builder.fadd(even, odd, flags=FAST)
        place = builder.bitcast(_pointer(context, builder, kinds[0], args[0], args[1]), total.type.as_pointer())
        builder.store(total, place, align=16)
        return context.get_dummy_value()

    return signature, emit


@intrinsic
def place(
    typing: Any, corners: Any, weights: Any, at: Any, table: Any, bricks: Any, begin: Any, ny: Any, nz: Any, i: Any,
    j: Any, k: Any, fx: Any, fy: Any, fz: Any,
) -> Any:  # fmt: skip
    """Write the offsets in `rows` of the 8 vertices of cell (i, j, k), z fastest, and the trilinear weights of a point.

    table: the numbers of bricks of 4³ cells, int32; those of the cell's size begin at `begin`, with ny and nz bricks
    along y and z. bricks: the rows of each one's 5³ vertices, int32. fx, fy, fz: where the point lies in its cell.
    """
    integer, real = types.int64, types.float32
    signature = types.void(
        corners, weights, integer, table, bricks, integer, integer, integer, integer, integer, integer, real, real, real
    )
    pair_of_longs, eight_ints = ir.VectorType(_I64, 2), ir.VectorType(_I32, 8)

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        kinds = signature.args

        def number(value: int) -> Any:
            return ir.Constant(_I64, value)

        brick: Any = number(0)
        vertex: Any = number(0)
        weight: Any = None
        sides = ([0, 0, 0, 0, 1, 1, 1, 1], [0, 0, 1, 1, 0, 0, 1, 1], [0, 1, 0, 1, 0, 1, 0, 1])
        for axis, side in enumerate(sides):
            if axis:
                brick = builder.mul(brick, args[5 + axis])
            brick = builder.add(brick, builder.ashr(args[8 + axis], number(2)))
            inside = builder.and_(args[8 + axis], number(3))
            vertex = builder.add(vertex, builder.mul(inside, number(5 ** (2 - axis))))
            near = builder.fsub(ir.Constant(_FLOAT, 1.0), args[11 + axis])
            pair = builder.insert_element(
                ir.Constant(ir.VectorType(_FLOAT, 2), ir.Undefined), near, ir.Constant(_I32, 0)
            )
            pair = builder.insert_element(pair, args[11 + axis], ir.Constant(_I32, 1))
            share = builder.shuffle_vector(pair, pair, ir.Constant(eight_ints, side))
            weight = share if weight is None else builder.fmul(weight, share)
        table = builder.gep(_pointer(context, builder, kinds[3], args[3], args[5]), [brick])
        first = builder.mul(builder.sext(builder.load(table), _I64), number(5**3))
        for q in range(4):  # vertices beside each other along z
            corner = builder.add(builder.add(first, vertex), number(25 * (q >> 1) + 5 * (q & 1)))
            source = _pointer(context, builder, kinds[4], args[4], corner)
            rows = builder.load(builder.bitcast(source, ir.VectorType(_I32, 2).as_pointer()), align=4)
            offsets = builder.shl(builder.sext(rows, pair_of_longs), ir.Constant(pair_of_longs, [4] * 2))
            target = _pointer(context, builder, kinds[0], args[0], builder.add(args[2], number(2 * q)))
            builder.store(offsets, builder.bitcast(target, pair_of_longs.as_pointer()), align=16)
        weights = _pointer(context, builder, kinds[1], args[1], args[2])
        builder.store(weight, builder.bitcast(weights, weight.type.as_pointer()), align=32)
        return context.get_dummy_value()

    return signature, emit


@intrinsic
def scatter(typing: Any, rows: Any, corners: Any, weights: Any, first: Any, row: Any, at: Any) -> Any:
    """rows[corners[first + k] : + 16] += weights[first + k] · row[at : at + 16], k < 8: the transpose of `gather`."""
    signature = types.void(rows, corners, weights, types.int64, row, types.int64)

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        kinds = signature.args
        target = _pointer(context, builder, kinds[0], args[0])
        offsets = _pointer(context, builder, kinds[1], args[1], args[3])
        factors = _pointer(context, builder, kinds[2], args[2], args[3])
        value = _load(builder, _pointer(context, builder, kinds[4], args[4], args[5]))
        for k in range(8):
            place = builder.gep(target, [_item(builder, offsets, k)])
            part = builder.fmul(_splat(builder, _item(builder, factors, k)), value, flags=FAST)
            _store(builder, builder.fadd(_load(builder, place), part, flags=FAST), place)
        return context.get_dummy_value()

    return signature, emit


@intrinsic
def scatter_smooth(
    typing: Any, rows: Any, corners: Any, weights: Any, first: Any, row: Any, at: Any, values: Any, strength: Any,
    linear: Any,
) -> Any:  # fmt: skip
    """`scatter`, and rows[corner k] += row[strength : + 16] · (values[corner k] − mean) + row[linear : + 16] · l_k.

    The mean is that of the 8 corners' values, and mean + l_k is the linear function nearest to them, at corner k. All
    in one pass, because most of the time goes into reading and writing the rows.
    """
    long = types.int64
    signature = types.void(rows, corners, weights, long, row, long, values, long, long)

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        kinds = signature.args
        target = _pointer(context, builder, kinds[0], args[0])
        corners_at = _pointer(context, builder, kinds[1], args[1], args[3])
        factors = _pointer(context, builder, kinds[2], args[2], args[3])
        value, factor, along = (
            _load(builder, _pointer(context, builder, kinds[4], args[4], args[q])) for q in (5, 7, 8)
        )
        source = _pointer(context, builder, kinds[6], args[6])
        offsets = [_item(builder, corners_at, k) for k in range(8)]
        values = [_load(builder, builder.gep(source, [offset])) for offset in offsets]

        def plus(one: Any, other: Any) -> Any:
            return builder.fadd(one, other, flags=FAST)

        def minus(one: Any, other: Any) -> Any:
            return builder.fsub(one, other, flags=FAST)

        def times(one: Any, other: Any) -> Any:
            return builder.fmul(one, other, flags=FAST)

        along = times(along, ir.Constant(_ROW, [0.125] * 16))
        # z is fastest: first the sums over z and the steps along it, from these the same along y, and along x
        over_z = [plus(values[k], values[k + 1]) for k in (0, 2, 4, 6)]
        along_z = [minus(values[k + 1], values[k]) for k in (0, 2, 4, 6)]
        over_yz = [plus(over_z[k], over_z[k + 1]) for k in (0, 2)]
        along_y = [minus(over_z[k + 1], over_z[k]) for k in (0, 2)]
        x, y = times(minus(over_yz[1], over_yz[0]), along), times(plus(*along_y), along)
        z = times(plus(plus(along_z[0], along_z[1]), plus(along_z[2], along_z[3])), along)
        ends = [times(times(plus(*over_yz), ir.Constant(_ROW, [-0.125] * 16)), factor)]
        for step in (x, y, z):  # to −mean · factor ± x ± y ± z, in the order of the corners
            ends = [side(end, step) for end in ends for side in (minus, plus)]
        for k, (offset, one) in enumerate(zip(offsets, values, strict=True)):
            place = builder.gep(target, [offset])
            part = plus(times(one, factor), ends[k])
            part = plus(part, times(_splat(builder, _item(builder, factors, k)), value))
            _store(builder, plus(_load(builder, place), part), place)
        return context.get_dummy_value()

    return signature, emit


@intrinsic
def prefetch(typing: Any, rows: Any, corners: Any, first: Any) -> Any:
    """Prefetch the 8 rows into the cache: their addresses are random, so that the processor cannot guess them."""
    signature = types.void(rows, corners, types.int64)

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        source = _pointer(context, builder, signature.args[0], args[0])
        offsets = _pointer(context, builder, signature.args[1], args[1], args[2])
        name = "llvm.prefetch.p0i8"
        hint = builder.module.globals.get(name)
        if hint is None:
            hint = ir.Function(
                builder.module, ir.FunctionType(ir.VoidType(), [_I8.as_pointer(), _I32, _I32, _I32]), name
            )
        read, keep, data = (ir.Constant(_I32, v) for v in (0, 3, 1))
        for k in range(8):
            place = builder.bitcast(builder.gep(source, [_item(builder, offsets, k)]), _I8.as_pointer())
            builder.call(hint, [place, read, keep, data])
        return context.get_dummy_value()

    return signature, emit


@intrinsic
def _as_float(typing: Any, bits: Any) -> Any:
    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.bitcast(args[0], _FLOAT)

    return types.float32(types.int32), emit


@intrinsic
def _as_int(typing: Any, x: Any) -> Any:
    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.bitcast(args[0], _I32)

    return types.int32(types.float32), emit


@inlined
def exp(x: Any) -> Any:
    """eˣ in float32 with a relative error under 2e-7. x is clamped to ±87, beyond which float32 has infinity and zero.

    x = n ln 2 + r: the bits of 2ⁿ are set directly, and eʳ for |r| ≤ ln 2 / 2 is the minimax polynomial of Cephes. A
    call into the C library would take longer than the rest of a sample's arithmetic.
    """
    x = min(max(x, np.float32(-87)), np.float32(87))
    n = np.floor(x * np.float32(1.44269504) + np.float32(0.5))
    r = x - n * np.float32(0.693359375) + n * np.float32(2.12194440e-4)  # ln 2 in two parts: n times the first is exact
    p = np.float32(1.98756915e-4)
    p = p * r + np.float32(1.39819995e-3)
    p = p * r + np.float32(8.33345191e-3)
    p = p * r + np.float32(4.16657959e-2)
    p = p * r + np.float32(1.66666655e-1)
    p = p * r + np.float32(5.00000012e-1)
    return (p * r * r + r + np.float32(1)) * _as_float(np.int32((np.int32(n) + np.int32(127)) << np.int32(23)))


@inlined
def log(x: Any) -> Any:
    """ln x in float32 for normal x > 0, with an error under 2e-7 of 1 + |ln x|. It can be part of a vector, like `exp`.

    x = 2ⁿ m with √½ ≤ m < √2: n comes from the bits, and ln m is the polynomial of Cephes in m − 1.
    """
    bits = _as_int(x)
    n = np.int32((bits - np.int32(0x3F3504F3)) >> np.int32(23))  # the bits of √½
    f = _as_float(np.int32(bits - (n << np.int32(23)))) - np.float32(1)
    e = np.float32(n)
    p = np.float32(7.0376836292e-2)
    p = p * f - np.float32(1.1514610310e-1)
    p = p * f + np.float32(1.1676998740e-1)
    p = p * f - np.float32(1.2420140846e-1)
    p = p * f + np.float32(1.4249322787e-1)
    p = p * f - np.float32(1.6668057665e-1)
    p = p * f + np.float32(2.0000714765e-1)
    p = p * f - np.float32(2.4999993993e-1)
    p = p * f + np.float32(3.3333331174e-1)
    z = f * f
    return (f + (p * f * z - e * np.float32(2.12194440e-4) - np.float32(0.5) * z)) + e * np.float32(0.693359375)
