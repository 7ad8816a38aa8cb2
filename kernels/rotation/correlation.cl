// Least squares of mean, cosine and sine over the phases of a rotation. Specification: correlation.py.
//
// FRAME  type of a sample
// BITS   its width; samples of 32 bits are not counts
// TILE   pixels of one work-item: 1 on a GPU, many on a CPU

#pragma OPENCL FP_CONTRACT OFF
#include "common.clh"

// --- The fit from sums --------------------------------------------------------------------------------------------

#if TILE > 1 && defined(cl_khr_fp64)  // float64 of a CPU is faster than pairs of floats
typedef double Exact;
#define EXACT(pair) ((double)(pair).high + (pair).rest)
#define FLOAT(x) ((float)(x))
#define ROW(i) (FIT(3 * i) * a + FIT(3 * i + 1) * b + FIT(3 * i + 2) * c)
#define MISFIT(square) (square - (x * x + y * y + z * z))
#else
typedef Pair Exact;
#define EXACT(pair) (pair)
#define FLOAT(x) (x).high
#define ROW(i) normalised(plus(plus(times(FIT(3 * i), a), times(FIT(3 * i + 1), b)), times(FIT(3 * i + 2), c)))
#define MISFIT(square) normalised(minus(square, plus(plus(times(x, x), times(y, y)), times(z, z))))
#endif
#define FIT(i) EXACT(((Pair){fit[i], fit[9 + (i)]}))

// Results of pixel p from the sums of its samples, minus a reference, and of their squares.
#define ANSWER(p, reference, total, along, across, square) \
    { \
        const Exact a = total, b = along, c = across, x = ROW(0), y = ROW(1), z = ROW(2); \
        const float residual_square = FLOAT(MISFIT(square)); \
        mean[p] = reference + (fit[18] * FLOAT(x) + fit[19] * FLOAT(y) + fit[20] * FLOAT(z)); \
        cosine_part[p] = fit[22] * FLOAT(y) + fit[23] * FLOAT(z); \
        sine_part[p] = fit[26] * FLOAT(z); \
        residual[p] = root((residual_square < 0 ? 0 : residual_square) * fit[27]); \
    }

// --- Sums of integer counts: nothing is rounded -------------------------------------------------------------------

#if BITS < 32
#if BITS == 8
typedef int Narrow;
#else
typedef long Narrow;
#endif
#define WINDOW 64  // frames whose sums fit into Narrow

// The sums of a pixel in some type, minus a reference: an integer near the mean of its samples.
#define CENTRE(Sum, total, cosine, sine, square) \
    const int centre = (int)((float)total * (1 / (float)used) + 0.5f); \
    const Sum rest = total - (Sum)centre * used, along = cosine - centre * (Sum)cosines, \
              across = sine - centre * (Sum)sines, spread = square - centre * (total + rest);
#define PAIR_OF(Sum, a) ((Pair){(float)(a), (float)((a) - (Sum)(float)(a))})
#if TILE > 1 && defined(cl_khr_fp64)
#define EXACTLY(Sum, a) (double)(a)
#else
#define EXACTLY(Sum, a) PAIR_OF(Sum, a)
#endif
#define ANSWER_COUNTS(Sum, p) \
    ANSWER(p, centre, EXACTLY(Sum, rest), EXACTLY(Sum, along), EXACTLY(Sum, across), EXACTLY(Sum, spread))

// One of several frames whose samples are added to a pixel's sums a, b, c and d together.
#define SIDE(i) \
    __global const FRAME *restrict frame##i = frames + (size_t)place[t + i] * each + low; \
    const Narrow cosine##i = basis[3 * (t + i) + 1], sine##i = basis[3 * (t + i) + 2];
#define TAKE(i) \
    now = frame##i[p]; \
    a += now; \
    b += cosine##i * now; \
    c += sine##i * now; \
    d += now * now;
#define PIXELS(take) \
    for (int p = 0; p < width; ++p) { \
        Narrow now, a = totals[p], b = waves[p], c = others[p], d = squares[p]; \
        take \
        totals[p] = a; \
        waves[p] = b; \
        others[p] = c; \
        squares[p] = d; \
    }

// Sums of the frames from `start` to before `stop`, at most WINDOW, for the pixels from `low` on.
#define SUM(start, stop) \
    Narrow totals[TILE], waves[TILE], others[TILE], squares[TILE]; \
    for (int p = 0; p < width; ++p) totals[p] = waves[p] = others[p] = squares[p] = 0; \
    int t = start; \
    for (; t + 8 <= stop; t += 8) { \
        SIDE(0) SIDE(1) SIDE(2) SIDE(3) SIDE(4) SIDE(5) SIDE(6) SIDE(7) \
        PIXELS(TAKE(0) TAKE(1) TAKE(2) TAKE(3) TAKE(4) TAKE(5) TAKE(6) TAKE(7)) \
    } \
    for (; t < stop; ++t) { \
        SIDE(0) \
        PIXELS(TAKE(0)) \
    }

__kernel void correlation_window(
    __global const FRAME *restrict frames, const int count, const int pixels, const int each,
    __global const int *restrict place, __global const int *restrict basis, const int used, const long cosines,
    const long sines, MAP fit, OUT mean, OUT cosine_part, OUT sine_part, OUT residual)
{
    const int low = get_global_id(0) * TILE, width = min(TILE, pixels - low);
    SUM(0, count)
    for (int p = 0; p < width; ++p) {
        CENTRE(Narrow, totals[p], waves[p], others[p], squares[p])
        ANSWER_COUNTS(Narrow, low + p)
    }
}

__kernel void correlation_add(
    __global const FRAME *restrict frames, const int count, const int pixels, const int each,
    __global const int *restrict place, __global const int *restrict basis, const int first,
    __global long *restrict total, __global long *restrict cosine, __global long *restrict sine,
    __global long *restrict square)
{
    const int low = get_global_id(0) * TILE, width = min(TILE, pixels - low);
    for (int start = 0; start < count; start += WINDOW) {
        const int stop = min(count, start + WINDOW), started = first > 0 || start > 0;
        SUM(start, stop)
        for (int p = 0; p < width; ++p) {
            total[low + p] = totals[p] + (started ? total[low + p] : 0);
            cosine[low + p] = waves[p] + (started ? cosine[low + p] : 0);
            sine[low + p] = others[p] + (started ? sine[low + p] : 0);
            square[low + p] = squares[p] + (started ? square[low + p] : 0);
        }
    }
}

__kernel void correlation_solve_counts(
    const int pixels, const int used, const long cosines, const long sines, __global const long *restrict total,
    __global const long *restrict cosine, __global const long *restrict sine, __global const long *restrict square,
    MAP fit, OUT mean, OUT cosine_part, OUT sine_part, OUT residual)
{
    const int low = get_global_id(0) * TILE, end = min(pixels, low + TILE);
    for (int p = low; p < end; ++p) {
        CENTRE(long, total[p], cosine[p], sine[p], square[p])
        ANSWER_COUNTS(long, p)
    }
}

#define AS_LONG(a, factor) as_long((float2)(factor * (float)(a), factor * PAIR_OF(long, a).rest))

__kernel void correlation_convert(
    const int pixels, const int used, const long cosines, const long sines, const float unit, OUT reference,
    __global long *restrict total, __global long *restrict cosine, __global long *restrict sine,
    __global long *restrict square)
{
    const int low = get_global_id(0) * TILE, end = min(pixels, low + TILE);
    for (int p = low; p < end; ++p) {
        CENTRE(long, total[p], cosine[p], sine[p], square[p])
        reference[p] = centre;
        total[p] = AS_LONG(rest, 1);
        cosine[p] = AS_LONG(along, unit);
        sine[p] = AS_LONG(across, unit);
        square[p] = AS_LONG(spread, 1);
    }
}
#endif

// --- Sums of any samples minus their references -------------------------------------------------------------------

enum { TOTAL, COSINE, SINE, SQUARE, SUMS };

typedef struct {
    float reference[TILE], high[SUMS][TILE], rest[SUMS][TILE];
} Sums;

#define GET(k) ((Pair){sums->high[k][p], sums->rest[k][p]})
#define SET(k, value) \
    { \
        const Pair pair = value; \
        sums->high[k][p] = pair.high; \
        sums->rest[k][p] = pair.rest; \
    }

// Adds frames; before the first one, its sample becomes the reference. Inlined, because a GPU's lane would
// otherwise keep its sums in memory.
__attribute__((always_inline)) void add(
    Sums *restrict sums, const int first, const int width, __global const FRAME *restrict frames, const int count,
    const int each, __global const int *restrict place, MAP basis)
{
    for (int p = 0; p < width && first == 0; ++p) {
        sums->reference[p] = frames[(size_t)place[0] * each + p];
        SET(TOTAL, ((Pair){0, 0}))
        SET(COSINE, ((Pair){0, 0}))
        SET(SINE, ((Pair){0, 0}))
        SET(SQUARE, ((Pair){0, 0}))
    }
    for (int t = 0; t < count; ++t) {
        __global const FRAME *restrict frame = frames + (size_t)place[t] * each;
        const float weight = basis[3 * t], cosine = basis[3 * t + 1], sine = basis[3 * t + 2];
        for (int p = 0; p < width; ++p) {
            const float sample = (float)frame[p] - sums->reference[p];
            SET(TOTAL, normalised(plus(GET(TOTAL), product_of(weight, sample))))
            SET(COSINE, normalised(plus(GET(COSINE), product_of(cosine, sample))))
            SET(SINE, normalised(plus(GET(SINE), product_of(sine, sample))))
            const Pair square = product_of(sample, sample);
            Pair part = product_of(weight, square.high);
            part.rest += weight * square.rest;
            SET(SQUARE, normalised(plus(GET(SQUARE), part)))
        }
    }
}

#define PAIR(pair) ((Pair){(pair).x, (pair).y})

__kernel void correlation_sum(
    __global const FRAME *restrict frames, const int count, const int pixels, const int each,
    __global const int *restrict place, MAP basis, const int first, OUT reference, __global float2 *restrict total,
    __global float2 *restrict cosine, __global float2 *restrict sine, __global float2 *restrict square)
{
    const int low = get_global_id(0) * TILE, width = min(TILE, pixels - low);
    Sums here, *sums = &here;
    for (int p = 0; p < width && first > 0; ++p) {
        sums->reference[p] = reference[low + p];
        SET(TOTAL, PAIR(total[low + p]))
        SET(COSINE, PAIR(cosine[low + p]))
        SET(SINE, PAIR(sine[low + p]))
        SET(SQUARE, PAIR(square[low + p]))
    }
    add(sums, first, width, frames + low, count, each, place, basis);
    for (int p = 0; p < width; ++p) {
        reference[low + p] = sums->reference[p];
        total[low + p] = (float2)(sums->high[TOTAL][p], sums->rest[TOTAL][p]);
        cosine[low + p] = (float2)(sums->high[COSINE][p], sums->rest[COSINE][p]);
        sine[low + p] = (float2)(sums->high[SINE][p], sums->rest[SINE][p]);
        square[low + p] = (float2)(sums->high[SQUARE][p], sums->rest[SQUARE][p]);
    }
}

__kernel void correlation_solve_pairs(
    const int pixels, MAP reference, __global const float2 *restrict total, __global const float2 *restrict cosine,
    __global const float2 *restrict sine, __global const float2 *restrict square, MAP fit, OUT mean, OUT cosine_part,
    OUT sine_part, OUT residual)
{
    const int low = get_global_id(0) * TILE, end = min(pixels, low + TILE);
    for (int p = low; p < end; ++p)
        ANSWER(p, reference[p], EXACT(PAIR(total[p])), EXACT(PAIR(cosine[p])), EXACT(PAIR(sine[p])), EXACT(PAIR(square[p])))
}

// Both at once, if the samples are not kept.
__kernel void correlation_window_pairs(
    __global const FRAME *restrict frames, const int count, const int pixels, const int each,
    __global const int *restrict place, MAP basis, MAP fit, OUT mean, OUT cosine_part, OUT sine_part, OUT residual)
{
    const int low = get_global_id(0) * TILE, width = min(TILE, pixels - low);
    Sums here, *sums = &here;
    add(sums, 0, width, frames + low, count, each, place, basis);
    for (int p = 0; p < width; ++p)
        ANSWER(low + p, sums->reference[p], EXACT(GET(TOTAL)), EXACT(GET(COSINE)), EXACT(GET(SINE)), EXACT(GET(SQUARE)))
}
