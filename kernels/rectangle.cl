// Heights of a full rectangle: cosine modes of its lines, a tridiagonal system for each of them across the lines, and back.
// Specification: rectangle.py.
//
// LANES  lines side by side in a vector: 8 where an item is a core's loop, 1 where it is a lane
// ROOM   complex numbers of an item's own memory, `size` or more; 0 where they lie in `scratch`
// CHIRP  1 where `length` has a large prime factor: its Fourier transform is then a convolution (Bluestein 1970) of `size` points
//
// An item transforms 2 * LANES lines at once. In each lane one of them is the real part of complex numbers and another the
// imaginary part, and a butterfly is plain arithmetic on vectors. With the even points of a line forwards and then the odd ones
// backwards, its cosine modes are the parts of its Fourier transform, turned (Makhoul 1980).
//
// The Fourier transform stays in its place. `plan` has for each step its radix, the distance of the numbers that it adds, and
// where its factors begin. Afterwards the modes are out of order: `place` says where modes k and length - k are. Backwards, with
// real and imaginary parts exchanged, the same steps in reverse lead from there to the points.
//
// Lines are rows of the picture where `along` is 1, and its columns where it is 0.
//
// The spectrum lies in strips of 16 slots, for modes k ... k + 7 and length - k ... length - k - 7; a strip has 16 numbers of
// each of `padded` lines.

#include "common.clh"

#define HALF 8
#define SLOTS 16
#define STEPS const int steps, __global const int *restrict plan, MAP factors


#if LANES == 8
typedef float8 F;
#else
typedef float F;
#endif

#if ROOM
typedef F *Point;
#define STRIDE 1
#define WORK Point work
#define MINE work
#define SCRATCH
#define TAKE_WORK F work[2 * ROOM];
#else
typedef __global F *Point;
#define STRIDE stride
#define WORK Point work, const long stride
#define MINE work, stride
#define SCRATCH , __global F *restrict scratch
#if LANES == 8
#define TAKE_WORK const long stride = 1; Point work = scratch + 2 * (long)get_global_id(0) * size;
#else
#define TAKE_WORK const long stride = padded / 2; Point work = scratch + get_global_id(0);
#endif
#endif
#define AT(n) (work + 2 * STRIDE * (long)(n))

// ---- Fourier transforms in their place

#define GET(n, at) F r##n = (at)[0], i##n = (at)[STRIDE];
#define PUT(n, at) (at)[0] = r##n; (at)[STRIDE] = i##n;
#define TURN(n, factor)                                     \
    {                                                       \
        const float c = (factor)[0], s = (factor)[1];       \
        const F old = r##n;                                 \
        r##n = c * old - s * i##n;                          \
        i##n = s * old + c * i##n;                          \
    }

// Fourier transforms of 2 ... 5 numbers.
#define ADD_2                                                           \
    const F br = r0 - r1, bi = i0 - i1;                                 \
    r0 += r1; i0 += i1; r1 = br; i1 = bi;
#define ADD_3                                                           \
    const F ar = r1 + r2, ai = i1 + i2;                                 \
    const F br = 0.866025404f * (r1 - r2), bi = 0.866025404f * (i1 - i2); \
    const F cr = r0 - 0.5f * ar, ci = i0 - 0.5f * ai;                   \
    r0 += ar; i0 += ai;                                                 \
    r1 = cr + bi; i1 = ci - br; r2 = cr - bi; i2 = ci + br;
#define ADD_4                                                           \
    const F ar = r0 + r2, ai = i0 + i2, br = r0 - r2, bi = i0 - i2;     \
    const F cr = r1 + r3, ci = i1 + i3, dr = r1 - r3, di = i1 - i3;     \
    r0 = ar + cr; i0 = ai + ci; r2 = ar - cr; i2 = ai - ci;             \
    r1 = br + di; i1 = bi - dr; r3 = br - di; i3 = bi + dr;
#define ADD_5                                                           \
    const F ar = r1 + r4, ai = i1 + i4, br = r1 - r4, bi = i1 - i4;     \
    const F cr = r2 + r3, ci = i2 + i3, dr = r2 - r3, di = i2 - i3;     \
    const F er = r0 + 0.309016994f * ar - 0.809016994f * cr, ei = i0 + 0.309016994f * ai - 0.809016994f * ci; \
    const F gr = r0 - 0.809016994f * ar + 0.309016994f * cr, gi = i0 - 0.809016994f * ai + 0.309016994f * ci; \
    const F hr = 0.951056516f * br + 0.587785252f * dr, hi = 0.951056516f * bi + 0.587785252f * di; \
    const F kr = 0.587785252f * br - 0.951056516f * dr, ki = 0.587785252f * bi - 0.951056516f * di; \
    r0 += ar + cr; i0 += ai + ci;                                       \
    r1 = er + hi; i1 = ei - hr; r4 = er - hi; i4 = ei + hr;             \
    r2 = gr + ki; i2 = gi - kr; r3 = gr - ki; i3 = gi + kr;

#define ALL_2(act) act(0) act(1)
#define ALL_3(act) ALL_2(act) act(2)
#define ALL_4(act) ALL_3(act) act(3)
#define ALL_5(act) ALL_4(act) act(4)
#define GET_FAR(n) GET(n, work + (n) * far)
#define PUT_FAR(n) PUT(n, work + (n) * far)
#define TURN_FAR(n) if (n > 0) TURN(n, turn + 2 * (n) - 2)

#define DOWN 0   // to modes: numbers are turned after they were added
#define UP 1     // to points: before
#define LEVEL 2  // not at all

// Adds numbers that are `far` from each other, again and again `next` further, in several blocks.
#define STEP(radix)                                                                                    \
    void step_##radix(                                                                                 \
        WORK, const int blocks, const int inner, const long next, const long far, MAP turns, const int way) \
    {                                                                                                  \
        for (int block = 0; block < blocks; ++block, work += radix * far - inner * next) {             \
            MAP turn = turns;                                                                        \
            for (int j = 0; j < inner; ++j, work += next, turn += 2 * (radix - 1)) {                   \
                ALL_##radix(GET_FAR)                                                                   \
                if (way == UP) { ALL_##radix(TURN_FAR) }                                               \
                ADD_##radix                                                                            \
                if (way == DOWN) { ALL_##radix(TURN_FAR) }                                             \
                ALL_##radix(PUT_FAR)                                                                   \
            }                                                                                          \
        }                                                                                              \
    }
STEP(2)
STEP(3)
STEP(4)
STEP(5)

#define MOST_PAIRS 15

// Numbers n and radix - n go together: cosines meet their sums, sines their differences.
void step_odd(
    WORK, const int blocks, const int inner, const long next, const long far, MAP turns, const int way, const int radix,
    MAP roots)
{
    const int pairs = radix / 2;
    for (int block = 0; block < blocks; ++block, work += radix * far - inner * next) {
        MAP turn = turns - 2;
        for (int j = 0; j < inner; ++j, work += next, turn += 2 * (radix - 1)) {
            F sum_r[MOST_PAIRS], sum_i[MOST_PAIRS], off_r[MOST_PAIRS], off_i[MOST_PAIRS];
            GET(0, work)
            F all_r = r0, all_i = i0;
            for (int n = 1; n <= pairs; ++n) {
                const int other = radix - n;
                GET(1, work + n * far) GET(2, work + other * far)
                if (way == UP) { TURN(1, turn + 2 * n) TURN(2, turn + 2 * other) }
                sum_r[n - 1] = r1 + r2; sum_i[n - 1] = i1 + i2;
                off_r[n - 1] = r1 - r2; off_i[n - 1] = i1 - i2;
                all_r += r1 + r2; all_i += i1 + i2;
            }
            work[0] = all_r; work[STRIDE] = all_i;
            for (int k = 1; k <= pairs; ++k) {
                const int other = radix - k;
                F ar = r0, ai = i0, br = 0.0f, bi = 0.0f;
                for (int n = 0, root = k; n < pairs; ++n) {
                    const float c = roots[2 * root], s = roots[2 * root + 1];
                    ar += c * sum_r[n]; ai += c * sum_i[n];
                    br += s * off_r[n]; bi += s * off_i[n];
                    root += root + k < radix ? k : k - radix;
                }
                F r1 = ar - bi, i1 = ai + br, r2 = ar + bi, i2 = ai - br;
                if (way == DOWN) { TURN(1, turn + 2 * k) TURN(2, turn + 2 * other) }
                PUT(1, work + k * far) PUT(2, work + other * far)
            }
        }
    }
}

void step(WORK, const int from, const int count, __global const int *restrict plan, MAP factors, const int way)
{
    const int radix = plan[0], q = plan[1], some = radix > 5 ? 2 * radix : 0;
    MAP roots = factors + plan[2];
    work = AT(from);
#define TAKE(blocks, inner, next, far, way)                                                            \
    if (radix == 4) step_4(MINE, blocks, inner, next, far, roots + some, way);                         \
    else if (radix == 2) step_2(MINE, blocks, inner, next, far, roots + some, way);                    \
    else if (radix == 3) step_3(MINE, blocks, inner, next, far, roots + some, way);                    \
    else if (radix == 5) step_5(MINE, blocks, inner, next, far, roots + some, way);                    \
    else step_odd(MINE, blocks, inner, next, far, roots + some, way, radix, roots);
    if (q > 1) {
        TAKE(count, q, 2 * STRIDE, 2 * STRIDE * q, way)
    } else {
        TAKE(1, count, 2 * STRIDE * radix, 2 * STRIDE, LEVEL)
    }
}

// The parts that the first step makes go one after the other through all others, while they are in the nearest cache.
#define PARTS (steps > 1 ? plan[0] : 0)
#define INNER(part, n) \
    step(MINE, (part) * plan[1], plan[1] / (plan[3 * (n)] * plan[3 * (n) + 1]), plan + 3 * (n), factors, way);

void to_modes(WORK, STEPS)
{
    const int way = DOWN;
    if (steps > 0) step(MINE, 0, 1, plan, factors, way);
    for (int part = 0; part < PARTS; ++part)
        for (int n = 1; n < steps; ++n) INNER(part, n)
}

void to_points(WORK, STEPS)
{
    const int way = UP;
    for (int part = 0; part < PARTS; ++part)
        for (int n = steps - 1; n > 0; --n) INNER(part, n)
    if (steps > 0) step(MINE, 0, 1, plan, factors, way);
}

#if CHIRP
#define CHIRPS , MAP chirp, MAP other
// With the numbers times a chirp, the transform is their convolution with another chirp, times the first: to modes, times the
// other's transform, and back. All in order.
void convolve(WORK, const int length, const int size, STEPS CHIRPS)
{
    for (int n = 0; n < size; ++n) {
        GET(0, AT(n))
        if (n < length) TURN(0, chirp + 2 * n)
        else r0 = i0 = 0.0f;
        PUT(0, AT(n))
    }
    to_modes(MINE, steps, plan, factors);
    for (int n = 0; n < size; ++n) {
        GET(1, AT(n))
        TURN(1, other + 2 * n)
        const F r0 = i1, i0 = r1;
        PUT(0, AT(n))
    }
    to_points(MINE, steps, plan, factors);
    for (int n = 0; n < length; ++n) {
        GET(1, AT(n))
        F r0 = i1, i0 = r1;
        TURN(0, chirp + 2 * n)
        PUT(0, AT(n))
    }
}
#define FIND_MODES convolve(MINE, length, size, steps, plan, factors, chirp, other);
#define FIND_POINTS FIND_MODES
#else
#define CHIRPS
#define FIND_MODES to_modes(MINE, steps, plan, factors);
#define FIND_POINTS to_points(MINE, steps, plan, factors);
#endif

// ---- Lines in lanes, and points or modes in lanes

#define PAIR (2 * LANES)
#define SPOT(n) ((n) & 1 ? length - 1 - (n) / 2 : (n) / 2)  // where point n of a line goes
#define PIXEL(line, n) (along ? (long)(line) * length + (n) : (long)(n) * lines + (line))

#if LANES == 8
typedef struct __attribute__((packed)) { F values; } Loose;  // a line begins anywhere
#define LOAD(from) (((__global const Loose *)(from))->values)
#define STORE(to, given) (((__global Loose *)(to))->values = (given))
#define EACH(i) for (int i = 0; i < 8; ++i)

#define SINGLES(a, b, c, d)                                                              \
    const F c = (F)(a.s0, b.s0, a.s1, b.s1, a.s4, b.s4, a.s5, b.s5);                     \
    const F d = (F)(a.s2, b.s2, a.s3, b.s3, a.s6, b.s6, a.s7, b.s7);
#define PAIRS(a, b, c, d)                                                                \
    const F c = (F)(a.s01, b.s01, a.s45, b.s45), d = (F)(a.s23, b.s23, a.s67, b.s67);
#define QUADS(a, b, c, d) c = (F)(a.s0123, b.s0123), d = (F)(a.s4567, b.s4567);
#define TRANSPOSE(v)                                                                     \
    {                                                                                    \
        SINGLES(v[0], v[1], a0, a1) SINGLES(v[2], v[3], a2, a3)                          \
        SINGLES(v[4], v[5], a4, a5) SINGLES(v[6], v[7], a6, a7)                          \
        PAIRS(a0, a2, b0, b1) PAIRS(a1, a3, b2, b3) PAIRS(a4, a6, b4, b5) PAIRS(a5, a7, b6, b7) \
        QUADS(b0, b4, v[0], v[4]) QUADS(b1, b5, v[1], v[5])                              \
        QUADS(b2, b6, v[2], v[6]) QUADS(b3, b7, v[3], v[7])                              \
    }

// Points n ... n + 7 of lines `line` ... `line` + 7; what is beyond the last line is harmless.
#define FETCH(v)                                                                         \
    if (along) {                                                                         \
        EACH(i) v[i] = LOAD(source + (long)LESSER(line + i, lines - 1) * length + n);    \
        TRANSPOSE(v)                                                                     \
    } else {                                                                             \
        const int8 known = line + (int8)(0, 1, 2, 3, 4, 5, 6, 7) < lines;                \
        EACH(i) v[i] = known ? LOAD(source + (long)LESSER(n + i, length - 1) * lines + line) : (F)0.0f; \
    }

// Some of a vector's numbers, side by side.
#define STORE_SOME(to, count, given)                                                     \
    if ((count) >= 8) STORE(to, given);                                                  \
    else {                                                                               \
        union { F all; float each[8]; } some;                                            \
        some.all = given;                                                                \
        for (int l = 0; l < (count); ++l) (to)[l] = some.each[l];                        \
    }

// Past the caches, where the compiler knows how: what is written there is not read before all of it is.
#ifdef __has_builtin
#if __has_builtin(__builtin_nontemporal_store)
#define STREAM(to, given) __builtin_nontemporal_store(given, to)
#endif
#endif
#ifndef STREAM
#define STREAM(to, given) (*(to) = (given))
#endif
// OpenCL's own does nothing in PoCL.
#ifdef POCL_DEVICE_ADDRESS_BITS
#define AHEAD(from) __builtin_prefetch(from)
#else
#define AHEAD(from) prefetch(from, 2)
#endif
#endif

__kernel void rectangle_modes(
    const int along, const int lines, const int padded, const int length, const int size, MAP source,
    __global const int *restrict place, MAP turns, STEPS CHIRPS, OUT spectrum SCRATCH)
{
    const int first = get_global_id(0) * PAIR;
    if (first >= lines) return;
    TAKE_WORK
    for (int side = 0; side < 2; ++side) {
        const int line = first + side * LANES;
        Point part = work + side * STRIDE;
        int n = 0;
#if LANES == 8
        F v[8];
        for (; n + 8 <= length; n += 8) {
            FETCH(v)
            Point even = part + n * STRIDE, odd = part + (2 * (length - 1) - n) * STRIDE;
            even[0] = v[0]; even[2 * STRIDE] = v[2]; even[4 * STRIDE] = v[4]; even[6 * STRIDE] = v[6];
            odd[0] = v[1]; odd[-2 * STRIDE] = v[3]; odd[-4 * STRIDE] = v[5]; odd[-6 * STRIDE] = v[7];
        }
        if (n < length) { FETCH(v) }
        for (int i = 0; n + i < length; ++i) part[2 * SPOT(n + i) * STRIDE] = v[i];
#else
        for (; n < length; ++n) part[2 * SPOT(n) * STRIDE] = source[PIXEL(LESSER(line, lines - 1), n)];
#endif
    }
    FIND_MODES
    for (int k = 0; k <= length / 2; k += HALF) {
        F low_1[HALF], low_2[HALF], high_1[HALF], high_2[HALF];
        for (int i = 0; i < HALF; ++i) {
            const float c = turns[2 * (k + i)], s = turns[2 * (k + i) + 1];
            GET(0, AT(place[2 * (k + i)]))
            GET(1, AT(place[2 * (k + i) + 1]))
            const F ar = r0 + r1, ai = i0 - i1, br = i0 + i1, bi = r1 - r0;
            low_1[i] = c * ar + s * ai;
            high_1[i] = s * ar - c * ai;
            low_2[i] = c * br + s * bi;
            high_2[i] = s * br - c * bi;
        }
        __global F *out = (__global F *)(spectrum + ((long)(k / HALF) * padded + first) * SLOTS);
#if LANES == 8
        TRANSPOSE(low_1) TRANSPOSE(high_1) TRANSPOSE(low_2) TRANSPOSE(high_2)
        EACH(i) { STREAM(out + 2 * i, low_1[i]); STREAM(out + 2 * i + 1, high_1[i]); }
        EACH(i) { STREAM(out + 2 * i + 16, low_2[i]); STREAM(out + 2 * i + 17, high_2[i]); }
#else
        for (int i = 0; i < HALF; ++i) {
            out[i] = low_1[i];
            out[HALF + i] = high_1[i];
            out[SLOTS + i] = low_2[i];
            out[SLOTS + HALF + i] = high_2[i];
        }
#endif
    }
}

__kernel void rectangle_heights(
    const int along, const int lines, const int padded, const int length, const int size, MAP spectrum,
    __global const int *restrict place, MAP turns, STEPS CHIRPS, OUT height SCRATCH)
{
    const int first = get_global_id(0) * PAIR;
    if (first >= lines) return;
    TAKE_WORK
    for (int k = 0; k <= length / 2; k += HALF) {
        F low_1[HALF], low_2[HALF], high_1[HALF], high_2[HALF];
        __global const F *in = (__global const F *)(spectrum + ((long)(k / HALF) * padded + first) * SLOTS);
#if LANES == 8
        EACH(i) { AHEAD(in + (long)padded * 2 + 4 * i); AHEAD(in + (long)padded * 2 + 4 * i + 2); }
        EACH(i) { low_1[i] = in[2 * i]; high_1[i] = in[2 * i + 1]; }
        EACH(i) { low_2[i] = in[2 * i + 16]; high_2[i] = in[2 * i + 17]; }
        TRANSPOSE(low_1) TRANSPOSE(high_1) TRANSPOSE(low_2) TRANSPOSE(high_2)
#else
        for (int i = 0; i < HALF; ++i) {
            low_1[i] = in[i];
            high_1[i] = in[HALF + i];
            low_2[i] = in[SLOTS + i];
            high_2[i] = in[SLOTS + HALF + i];
        }
#endif
        for (int i = 0; i < LESSER(HALF, length / 2 + 1 - k); ++i) {
            const float c = turns[2 * (k + i)], s = turns[2 * (k + i) + 1];
            const F ar = c * low_1[i] + s * high_1[i], ai = s * low_1[i] - c * high_1[i];
            const F br = c * low_2[i] + s * high_2[i], bi = s * low_2[i] - c * high_2[i];
            const F r0 = ai + br, i0 = ar - bi, r1 = br - ai, i1 = ar + bi;  // exchanged
            PUT(0, AT(place[2 * (k + i)]))
            PUT(1, AT(place[2 * (k + i) + 1]))
        }
    }
    FIND_POINTS
#if LANES == 8
    for (int side = 0; side < 2 && along; ++side) {
        const int line = first + side * LANES;
        Point part = work + (1 - side) * STRIDE;
        for (int n = 0; n < length; n += 16) {
            F v[8], w[8];
            if (n + 16 <= length) {
                Point even = part + n * STRIDE, odd = part + (2 * (length - 1) - n) * STRIDE;
                v[0] = even[0]; v[2] = even[2 * STRIDE]; v[4] = even[4 * STRIDE]; v[6] = even[6 * STRIDE];
                v[1] = odd[0]; v[3] = odd[-2 * STRIDE]; v[5] = odd[-4 * STRIDE]; v[7] = odd[-6 * STRIDE];
                w[0] = even[8 * STRIDE]; w[2] = even[10 * STRIDE]; w[4] = even[12 * STRIDE]; w[6] = even[14 * STRIDE];
                w[1] = odd[-8 * STRIDE]; w[3] = odd[-10 * STRIDE]; w[5] = odd[-12 * STRIDE]; w[7] = odd[-14 * STRIDE];
            } else {
                EACH(i) v[i] = part[2 * SPOT(LESSER(n + i, length - 1)) * STRIDE];
                EACH(i) w[i] = part[2 * SPOT(LESSER(n + 8 + i, length - 1)) * STRIDE];
            }
            TRANSPOSE(v)
            TRANSPOSE(w)
            for (int i = 0; i < LESSER(8, lines - line); ++i) {
                __global float *row = height + (long)(line + i) * length + n;
                STORE_SOME(row, length - n, v[i])
                STORE_SOME(row + 8, length - n - 8, w[i])
            }
        }
    }
    if (along) return;
#endif
    for (int n = 0; n < length; ++n)
        for (int side = 0; side < 2; ++side) {
            const int line = first + side * LANES;
            const F value = AT(SPOT(n))[(1 - side) * STRIDE];
#if LANES == 8
            STORE_SOME(height + (long)n * lines + line, lines - line, value)
#else
            if (line < lines) height[PIXEL(line, n)] = value;
#endif
        }
}

// ---- Across the lines

#if LANES == 8
#define NEXT 2  // vectors from line to line
#define SIDE_BY_SIDE(act, line) act(0, line) act(1, line)
#else
#define NEXT SLOTS
#define SIDE_BY_SIDE(act, line) act(0, line)
#endif

// Adds to a sum, and to its rest what rounding would lose.
#define ADD(sum, rest, term)                                            \
    {                                                                   \
        const F whole = (sum) + (term), part = whole - (sum);           \
        rest += ((sum) - (whole - part)) + ((term) - part);             \
        sum = whole;                                                    \
    }

F mean_of(const int lines, __global const F *restrict mode)
{
    F sum = 0.0f, rest = 0.0f;
    for (int line = 0; line < lines; ++line) ADD(sum, rest, mode[line * NEXT])
    return (sum + rest) / lines;
}

// The slowest modes: from line to line they hardly change, and each line's rounding would add to that of all others.
void march_slowly(
    const int lines, const F level, const int depth, __global const F *restrict rates, const F end,
    __global F *restrict mode)
{
    const F off = level * mean_of(lines, mode);
    F sum = 0.0f, rest = 0.0f;
    for (int line = 0; line < lines; ++line) {
        const F given = mode[line * NEXT] - off;
        ADD(sum, rest, given)
        mode[line * NEXT] = sum + rest;
        if (line == lines - 1) break;
        const F fades = rates[LESSER(line, depth - 1) * NEXT], lost = -fades * sum;
        rest -= fades * rest;
        ADD(sum, rest, lost)
    }
    sum *= end;
    rest *= end;
    for (int line = lines - 1; line >= 0; --line) {
        const F given = mode[line * NEXT], fades = rates[LESSER(line, depth - 1) * NEXT];
        ADD(sum, rest, given)
        const F lost = -fades * sum;
        rest -= fades * rest;
        ADD(sum, rest, lost)
        mode[line * NEXT] = sum + rest;
    }
    const F high = level * mean_of(lines, mode);
    for (int line = 0; line < lines; ++line) mode[line * NEXT] -= high;
}

#define BEGIN(n, line) F sum##n = mode[n], rate##n;
#define FORWARD_BY(n, line, rate)                                       \
    sum##n = (mode[(line) * NEXT + n] + sum##n) - (rate) * sum##n;      \
    mode[(line) * NEXT + n] = sum##n;
#define BACK_BY(n, line, rate)                                          \
    sum##n += mode[(line) * NEXT + n];                                  \
    sum##n -= (rate) * sum##n;                                          \
    mode[(line) * NEXT + n] = sum##n;
#define FORWARD_EARLY(n, line) FORWARD_BY(n, line, rates[((line) - 1) * NEXT + n])
#define FORWARD(n, line) FORWARD_BY(n, line, rate##n)
#define SETTLE(n, line) rate##n = rates[(line) * NEXT + n];
#define TURN_BACK(n, line) sum##n *= end[n];
#define BACK(n, line) BACK_BY(n, line, rate##n)
#define BACK_EARLY(n, line) BACK_BY(n, line, rates[(line) * NEXT + n])

__kernel void rectangle_columns(
    const int lines, const int padded, const int slots, const int level, __global const int *restrict reach, MAP fading,
    MAP ends, OUT spectrum)
{
    const int slot = get_global_id(0) * (LANES == 8 ? SLOTS : 1), strip = slot / SLOTS;
    if (slot >= slots) return;
    const int begin = reach[2 * strip], depth = reach[2 * strip + 1], lane = slot - strip * SLOTS;
    __global const F *restrict rates = (__global const F *)(fading + (long)begin * SLOTS + lane);
    __global const F *restrict end = (__global const F *)(ends + slot);
    __global F *restrict mode = (__global F *)(spectrum + (long)strip * padded * SLOTS + lane);

    if (strip == 0) {
#if LANES == 8
        march_slowly(lines, (F)(level, 0, 0, 0, 0, 0, 0, 0), depth, rates, end[0], mode);
        march_slowly(lines, (F)0.0f, depth, rates + 1, end[1], mode + 1);
#else
        march_slowly(lines, slot == 0 ? level : 0.0f, depth, rates, end[0], mode);
#endif
        return;
    }
    SIDE_BY_SIDE(BEGIN, 0)
    const int early = LESSER(depth, lines - 1);
    for (int line = 1; line <= early; ++line) { SIDE_BY_SIDE(FORWARD_EARLY, line) }
    SIDE_BY_SIDE(SETTLE, depth - 1)
    for (int line = early + 1; line < lines; ++line) { SIDE_BY_SIDE(FORWARD, line) }
    SIDE_BY_SIDE(TURN_BACK, 0)
    for (int line = lines - 1; line >= depth; --line) { SIDE_BY_SIDE(BACK, line) }
    for (int line = LESSER(depth, lines) - 1; line >= 0; --line) { SIDE_BY_SIDE(BACK_EARLY, line) }
}
