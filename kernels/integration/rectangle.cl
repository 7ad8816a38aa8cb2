// Heights of a full rectangle: cosine transforms of its rows and then of its columns, division by the eigenvalues, and the
// inverse transforms. Specification: rectangle.py.
//
// LANES    complex numbers in a vector: 8 on a CPU, 1 on a GPU
// ROOM     complex vectors in the local memory of a group, `size` or more; 0 if they are in `scratch`
// KNOWN    1 if known heights are given
// ODD      1 if a step has a radix of 7 or more: these need twice the registers
//
// A group transforms 2 * LANES lines at once, half of them as real parts of complex numbers and half as imaginary parts. If the
// even points of a line are arranged forwards and then the odd ones backwards, its cosine modes are the rotated parts of its
// Fourier transform (Makhoul 1980).
//
// The Fourier transform is in place. `plan` contains for each step its radix and the distance between the numbers that it adds;
// `roots` are the roots of 1. The resulting modes are permuted: `place` is the position of modes k and length - k. The inverse
// uses the same steps in reverse, with real and imaginary parts exchanged. If a length with a large prime factor is less than
// `size`, its transform is a convolution of `size` points (Bluestein 1970).
//
// The spectrum is stored in strips of 2 * LANES slots, for modes k, k + 1 ... of rows and then length - k, length - k - 1 ...
// A strip contains these slots for each of `padded` rows, and a group transforms all columns of a strip at once. Numbers of
// similar magnitude are paired, because each is affected by the rounding of the other.

#include "common.clh"

#define SLOTS (2 * LANES)

#if LANES == 8
typedef float8 F;
typedef float16 C;  // real parts, imaginary parts
#define ME 0
#define OTHERS 1
#define SYNC
#define SPACE
#else
typedef float F;
typedef float2 C;
#define ME ((int)get_local_id(0))
#define OTHERS ((int)get_local_size(0))
#define SYNC barrier(CLK_LOCAL_MEM_FENCE | CLK_GLOBAL_MEM_FENCE);
#define SPACE __local
#endif
#if ROOM
typedef SPACE C *Work;
#define TAKE_WORK SPACE C work[ROOM];
#else
typedef __global C *Work;
#define TAKE_WORK Work work = (Work)scratch + (long)get_group_id(0) * size;
#endif
#define EACH(i) for (int i = 0; i < LANES; ++i)
#define ALL(i, count) for (int i = ME; i < (count); i += OTHERS)  // divided among the items of a group
#define BLOCKS(i, count) for (int i = ME * LANES; i < (count); i += OTHERS * LANES)

// ---- Fourier transforms

#define LINES                                                                                              \
    const int length, const int size, const int steps, __global const int *restrict plan, MAP roots,       \
        __global const int *restrict place, MAP turns, MAP chirp, MAP other

C crossed(const C z) { return (C)(z.hi, z.lo); }
C conjugate(const C z) { return (C)(z.lo, -z.hi); }
C turned_back(const C z) { return (C)(z.hi, -z.lo); }  // by a quarter turn
C turned(const C z, MAP factor) { return factor[0] * z + factor[1] * (C)(-z.hi, z.lo); }

// A step adds numbers that are `far` apart, from number j of each block on: forwards (not `up`) they are
// rotated afterwards, backwards before.
#if LANES == 8
#define ALL_BLOCKS                                                                                         \
    for (int block = 0; block < size / span; ++block)                                                      \
        for (int j = 0; j < far; ++j)
#else
#define ALL_BLOCKS                                                                                         \
    for (int i = ME, block, j; block = (i + 0.5f) / far, j = i - block * far, block * span < size; i += OTHERS)
#endif
#define UNROLL _Pragma("unroll")
#define TURNED(n, value) turned(value, roots + 2 * (n) * j * apart)
#define STEP(radix, add)                                                                                   \
    void step_##radix(Work work, const int size, const int far, MAP roots, const int up)                   \
    {                                                                                                      \
        const int span = radix * far, apart = size / span;                                                 \
        ALL_BLOCKS {                                                                                       \
            Work at = work + block * span + j;                                                             \
            C z[radix];                                                                                    \
            UNROLL for (int n = 0; n < radix; ++n) z[n] = at[n * far];                                     \
            if (up && j) { UNROLL for (int n = 1; n < radix; ++n) z[n] = TURNED(n, z[n]); }                \
            add(radix)                                                                                     \
        }                                                                                                  \
    }
#define PUT_ALL(radix)                                                                                     \
    if (!up && j) { UNROLL for (int n = 1; n < radix; ++n) z[n] = TURNED(n, z[n]); }                       \
    UNROLL for (int n = 0; n < radix; ++n) at[n * far] = z[n];
#define ADD_2(radix)                                                                                       \
    const C last = z[0] - z[1];                                                                            \
    z[0] += z[1]; z[1] = last;                                                                             \
    PUT_ALL(2)
#define ADD_4(radix)                                                                                       \
    const C a = z[0] + z[2], b = z[0] - z[2], c = z[1] + z[3], d = turned_back(z[1] - z[3]);               \
    z[0] = a + c; z[1] = b + d; z[2] = a - c; z[3] = b - d;                                                \
    PUT_ALL(4)
// Numbers n and radix - n are combined: cosines multiply their sums, sines their differences.
#define ADD_ODD(radix, unroll)                                                                             \
    C all = z[0];                                                                                          \
    UNROLL for (int n = 1; n <= radix / 2; ++n) {                                                          \
        const C off = turned_back(z[radix - n] - z[n]);                                                    \
        z[n] += z[radix - n];                                                                              \
        z[radix - n] = off;                                                                                \
        all += z[n];                                                                                       \
    }                                                                                                      \
    at[0] = all;                                                                                           \
    unroll for (int k = 1; k <= radix / 2; ++k) {                                                          \
        C a = z[0], b = 0.0f;                                                                              \
        UNROLL for (int n = 1; n <= radix / 2; ++n) {                                                      \
            MAP root = roots + 2 * (k * n % radix) * (size / radix);                                       \
            a += root[0] * z[n];                                                                           \
            b += root[1] * z[radix - n];                                                                   \
        }                                                                                                  \
        at[k * far] = !up && j ? TURNED(k, a + b) : a + b;                                                 \
        at[(radix - k) * far] = !up && j ? TURNED(radix - k, a - b) : a - b;                               \
    }
#define ADD_FEW(radix) ADD_ODD(radix, UNROLL)
#define ADD_MANY(radix) ADD_ODD(radix, )  // with fewer registers
STEP(2, ADD_2)
STEP(3, ADD_FEW)
STEP(4, ADD_4)
STEP(5, ADD_FEW)
#if ODD
STEP(7, ADD_MANY)
STEP(11, ADD_MANY)
STEP(13, ADD_MANY)
#define TAKE_ODD TAKE(7) TAKE(11) TAKE(13)
#else
#define TAKE_ODD
#endif

#define TAKE(radix) case radix: step_##radix(work, size, plan[2 * n + 1], roots, up); break;

void take_steps(Work work, const int size, const int steps, __global const int *restrict plan, MAP roots, const int up)
{
    for (int step = 0; step < steps; ++step) {
        const int n = up ? steps - 1 - step : step;
        switch (plan[2 * n]) {
            TAKE(2) TAKE(3) TAKE(4) TAKE(5) TAKE_ODD
        }
        SYNC
    }
}

// With the numbers times a chirp, the transform is their convolution with another chirp, times the first one:
// forwards, times the other's transform, and backwards. All in order.
void transform(Work work, LINES, const int up)
{
    SYNC
    if (size == length) {
        take_steps(work, size, steps, plan, roots, up);
        return;
    }
    ALL(n, size) work[n] = n < length ? turned(work[n], chirp + 2 * n) : 0.0f;
    SYNC
    take_steps(work, size, steps, plan, roots, 0);
    ALL(n, size) work[n] = crossed(turned(work[n], other + 2 * n));
    SYNC
    take_steps(work, size, steps, plan, roots, 1);
    ALL(n, length) work[n] = turned(crossed(work[n]), chirp + 2 * n);
    SYNC
}
#define TRANSFORM(up) transform(work, length, size, steps, plan, roots, place, turns, chirp, other, up);

// Twice the cosine modes k and length - k of all lines, and the inverse; mode `length` is 0.
#define GET_MODES(k)                                                                                       \
    const float c = turns[2 * (k)], s = turns[2 * (k) + 1];                                                \
    const C z0 = work[place[2 * (k)]], z1 = work[place[2 * (k) + 1]];                                      \
    const C x = z0 + z1, y = turned_back(z0 - z1);                                                         \
    C low = c * x + s * y, high = s * x - c * y;
#define PUT_MODES(k)                                                                                       \
    {                                                                                                      \
        const float c = turns[2 * (k)], s = turns[2 * (k) + 1];                                            \
        const C x = crossed(c * low + s * high), y = conjugate(s * low - c * high);                        \
        work[place[2 * (k)]] = x + y;                                                                      \
        work[place[2 * (k) + 1]] = x - y;                                                                  \
    }
#define SPOT(n) ((n) & 1 ? length - 1 - (n) / 2 : (n) / 2)  // position of point n of a line

// ---- Rows: points or modes in lanes

#if LANES == 8
typedef struct __attribute__((packed)) { F values; } Loose;  // rows start at any address
#define LOAD(from) (((__global const Loose *)(from))->values)
#define STORE(to, stored) (((__global Loose *)(to))->values = (stored))
#define SINGLES(a, b, c, d)                                                                                \
    const F c = (F)(a.s0, b.s0, a.s1, b.s1, a.s4, b.s4, a.s5, b.s5);                                       \
    const F d = (F)(a.s2, b.s2, a.s3, b.s3, a.s6, b.s6, a.s7, b.s7);
#define PAIRS(a, b, c, d)                                                                                  \
    const F c = (F)(a.s01, b.s01, a.s45, b.s45), d = (F)(a.s23, b.s23, a.s67, b.s67);
#define QUADS(a, b, c, d) c = (F)(a.s0123, b.s0123), d = (F)(a.s4567, b.s4567);
#define TRANSPOSE(v)                                                                                       \
    {                                                                                                      \
        SINGLES(v[0], v[1], a0, a1) SINGLES(v[2], v[3], a2, a3)                                            \
        SINGLES(v[4], v[5], a4, a5) SINGLES(v[6], v[7], a6, a7)                                            \
        PAIRS(a0, a2, b0, b1) PAIRS(a1, a3, b2, b3) PAIRS(a4, a6, b4, b5) PAIRS(a5, a7, b6, b7)            \
        QUADS(b0, b4, v[0], v[4]) QUADS(b1, b5, v[1], v[5])                                                \
        QUADS(b2, b6, v[2], v[6]) QUADS(b3, b7, v[3], v[7])                                                \
    }
#define STORE_SOME(to, count, stored)                                                                      \
    {                                                                                                      \
        __global float *some = to;                                                                         \
        if (count >= LANES) STORE(some, stored);                                                           \
        else                                                                                               \
            for (int l = 0; l < count; ++l) some[l] = ((const float *)&stored)[l];                         \
    }
// Non-temporal stores, if the compiler supports them: the data are read only after all are written. With the
// prefetch of the next strip this saves a sixth of the time for 4 Mpx. OpenCL's own `prefetch` does nothing
// in PoCL.
#ifdef __has_builtin
#if __has_builtin(__builtin_nontemporal_store)
#define STREAM(to, stored) __builtin_nontemporal_store(stored, (__global F *)(to))
#endif
#endif
#ifdef POCL_DEVICE_ADDRESS_BITS
#define AHEAD(from) __builtin_prefetch(from);
#else
#define AHEAD(from)
#endif
#else
#define AHEAD(from)
#define LOAD(from) (*(from))
#define STORE(to, stored) (*(to) = (stored))
#define STORE_SOME(to, count, stored) STORE(to, stored);
#define TRANSPOSE(v)
#endif
#ifndef STREAM
#define STREAM STORE
#endif
#define SLOT(k, row) (((long)(k) / LANES * padded + (row)) * SLOTS)
#define POINTS(row, n) ((row) < rows ? LOAD(source + (long)(row) * length + n) : (F)0.0f)

__kernel void rectangle_modes(
    const int rows, const int padded, LINES, MAP source, OUT spectrum, __global float *restrict scratch)
{
    const int first = get_group_id(0) * SLOTS;
    TAKE_WORK
    BLOCKS(n, length) {
        F a[LANES], b[LANES];
        EACH(i) a[i] = POINTS(first + i, n);
        EACH(i) b[i] = POINTS(first + LANES + i, n);
        TRANSPOSE(a)
        TRANSPOSE(b)
        EACH(i) if (n + i < length) work[SPOT(n + i)] = (C)(a[i], b[i]);
    }
    TRANSFORM(0)
    BLOCKS(k, length / 2 + 1) {
        F low_a[LANES], low_b[LANES], high_a[LANES], high_b[LANES];
        EACH(i) {
            GET_MODES(k + i)
            low_a[i] = low.lo; low_b[i] = low.hi;
            high_a[i] = high.lo; high_b[i] = high.hi;
        }
        TRANSPOSE(low_a) TRANSPOSE(low_b) TRANSPOSE(high_a) TRANSPOSE(high_b)
        __global float *out = spectrum + SLOT(k, first);
        EACH(i) { STREAM(out + SLOTS * i, low_a[i]); STREAM(out + SLOTS * i + LANES, high_a[i]); }
        out += SLOTS * LANES;
        EACH(i) { STREAM(out + SLOTS * i, low_b[i]); STREAM(out + SLOTS * i + LANES, high_b[i]); }
    }
}

__kernel void rectangle_heights(
    const int rows, const int padded, LINES, MAP spectrum, OUT height, __global float *restrict scratch)
{
    const int first = get_group_id(0) * SLOTS;
    TAKE_WORK
    BLOCKS(k, length / 2 + 1) {
        F low_a[LANES], low_b[LANES], high_a[LANES], high_b[LANES];
        __global const float *in = spectrum + SLOT(k, first);
        for (int i = 0; i < SLOTS; ++i) AHEAD(in + ((long)padded + i) * SLOTS)
        EACH(i) { low_a[i] = LOAD(in + SLOTS * i); high_a[i] = LOAD(in + SLOTS * i + LANES); }
        in += SLOTS * LANES;
        EACH(i) { low_b[i] = LOAD(in + SLOTS * i); high_b[i] = LOAD(in + SLOTS * i + LANES); }
        TRANSPOSE(low_a) TRANSPOSE(low_b) TRANSPOSE(high_a) TRANSPOSE(high_b)
        EACH(i) {
            const C low = (C)(low_a[i], low_b[i]), high = (C)(high_a[i], high_b[i]);
            if (k + i <= length / 2) PUT_MODES(k + i)
        }
    }
    TRANSFORM(1)
    BLOCKS(n, length) {
        F v[2][LANES];
        EACH(i) {
            const C z = work[SPOT(LESSER(n + i, length - 1))];
            v[0][i] = z.hi;
            v[1][i] = z.lo;
        }
        TRANSPOSE(v[0])
        TRANSPOSE(v[1])
        for (int side = 0; side < 2; ++side)
            EACH(i) {
                const int row = first + side * LANES + i;
                if (row < rows) STORE_SOME(height + (long)row * length + n, length - n, v[side][i])
            }
    }
}

// ---- Columns

// For each of several pictures, stored one below the other. The level of all heights is dropped, unless it is
// NaN.
__kernel void rectangle_divide(
    const int pictures, const int padded, LINES, MAP along, MAP across, OUT spectrum, __global float *restrict scratch)
{
    const int strip = get_group_id(0) / pictures, picture = get_group_id(0) % pictures;
    __global C *column = (__global C *)spectrum + (long)strip * padded + picture * length;
    const C eigenvalue = ((__global const C *)along)[strip];
    TAKE_WORK
    ALL(n, length) work[SPOT(n)] = column[n];
    TRANSFORM(0)
    ALL(k, length / 2 + 1) {
        GET_MODES(k)
        low /= eigenvalue + across[k];
        high /= eigenvalue + across[length - k];
        if (k == 0 && strip == 0) low.s0 = 0.0f * high.s0;
        PUT_MODES(k)
    }
    TRANSFORM(1)
    ALL(n, length) column[n] = crossed(work[SPOT(n)]);
}

// ---- From slopes

#if KNOWN
#define IF_KNOWN(words) words
#define SLOPES                                                                                             \
    const int pictures, const int rows, const int columns, MAP dz_dx, MAP dz_dy, MAP known_heights, const float weight_z
#else
#define IF_KNOWN(words)
#define SLOPES const int pictures, const int rows, const int columns, MAP dz_dx, MAP dz_dy
#endif

// An item processes a piece of some rows of a picture; pictures are stored one below the other and have the
// same known heights. The border is processed separately: PoCL vectorises loops without branches.
#define ROWS 16
#define COLUMNS (LANES == 8 ? 256 : 1)
#define ALL_PIXELS(border, inner)                                                                          \
    const int pieces = (columns + COLUMNS - 1) / COLUMNS, item = get_global_id(0);                         \
    const int begin = item % pieces * COLUMNS, end = LESSER(columns, begin + COLUMNS);                     \
    const int strips = (rows + ROWS - 1) / ROWS, strip = item / pieces % strips, picture = item / pieces / strips; \
    const int before = picture * rows * columns, bottom = LESSER(rows, strip * ROWS + ROWS);               \
    for (int row = strip * ROWS; row < bottom && picture < pictures; ++row) {                              \
        const int first = before + row * columns;                                                          \
        int column = begin;                                                                                \
        for (; column < (row < 2 || row >= rows - 2 ? end : LESSER(end, 2)); ++column) border(first + column) \
        for (; column < LESSER(end, columns - 2); ++column) inner(first + column)                          \
        for (; column < end; ++column) border(first + column)                                              \
    }

// 24 times the slope of the link from pixel p to the next one in line: from four pixels, or at the ends from
// two.
#define LINK(slope, p, next)                                                                               \
    (13.0f * (slope[p] + slope[(p) + (next)]) - (slope[(p) - (next)] + slope[(p) + 2 * (next)]))

float link(MAP slope, const int p, const int next, const int n, const int count)
{
    if (n > 0 && n < count - 2) return LINK(slope, p, next);
    return n >= 0 && n < count - 1 ? 12.0f * (slope[p] + slope[p + next]) : 0.0f;
}

// The right-hand side: weights of links times their rise, of those that end in a pixel minus those that start
// there.
__kernel void rectangle_source(SLOPES, const float x, const float y, OUT source)
{
#define PUT_SOURCE(p, by_x, by_y) source[p] = x * (by_x) + y * (by_y) IF_KNOWN(+ weight_z * known_heights[p - before]);
#define ENDS(slope, p, next, n, count) link(slope, p - next, next, n - 1, count) - link(slope, p, next, n, count)
#define MIDST(slope, p, next)                                                                              \
    14.0f * (slope[p - next] - slope[p + next]) - (slope[p - 2 * next] - slope[p + 2 * next])
#define SOURCE_BORDER(p) PUT_SOURCE(p, ENDS(dz_dx, p, 1, column, columns), ENDS(dz_dy, p, columns, row, rows))
#define SOURCE_INNER(p) PUT_SOURCE(p, MIDST(dz_dx, p, 1), MIDST(dz_dy, p, columns))
    ALL_PIXELS(SOURCE_BORDER, SOURCE_INNER)
}

// Squared residuals of links and known heights times their weights, summed by item.
__kernel void rectangle_misfit(
    SLOPES, const float weight_x, const float weight_y, const float size_x, const float size_y, MAP relief, OUT sums)
{
    float squares[COLUMNS];
    for (int i = 0; i < COLUMNS; ++i) squares[i] = 0.0f;
#define ADD_SQUARES(p, right, below, x_link, y_link)                                                       \
    {                                                                                                      \
        const float x = relief[p + right] - relief[p] - size_x / 24 * (x_link);                            \
        const float y = relief[p + below] - relief[p] + size_y / 24 * (y_link);                            \
        IF_KNOWN(const float z = relief[p] - known_heights[p - before];)                                            \
        squares[column - begin] += weight_x * x * x + weight_y * y * y IF_KNOWN(+ weight_z * z * z);       \
    }
#define MISFIT_BORDER(p)                                                                                   \
    ADD_SQUARES(p, (column < columns - 1), (row < rows - 1 ? columns : 0),                                 \
        link(dz_dx, p, 1, column, columns), link(dz_dy, p, columns, row, rows))
#define MISFIT_INNER(p) ADD_SQUARES(p, 1, columns, LINK(dz_dx, p, 1), LINK(dz_dy, p, columns))
    ALL_PIXELS(MISFIT_BORDER, MISFIT_INNER)
    float sum = 0.0f;
    for (int i = 0; i < COLUMNS; ++i) sum += squares[i];
    if (picture < pictures) sums[item] = sum;
}
