// Least squares of mean, cosine and sine over the phases of a rotation. Specification: correlation.py.
//
// FRAME  type of a sample
// BITS   its width; samples of 32 bits are no counts
// WIDE   1 where sums hold any number of frames, 0 where they hold those of one window
// TILE   pixels of one work-item; 1 where an item is a lane, many where it is a core's loop

#pragma OPENCL FP_CONTRACT OFF
#include "common.clh"

#define WINDOW 64  // frames whose sums fit into Narrow
#define CHUNK (TILE < 256 ? TILE : 256)  // pixels whose sums stay in a core's nearest memory

// --- Sums of whole counts: nothing is rounded ---------------------------------------------------------------------

#if BITS < 32
#if BITS == 8
typedef int Narrow;
#else
typedef long Narrow;
#endif
#if WIDE
typedef long Sum;
#else
typedef Narrow Sum;
#endif

__kernel void correlation_slide(
    __global const FRAME *restrict frames, const int count, const int pixels, const int stride, const int first,
    const int window, __global const int *restrict basis, __global FRAME *restrict ring, __global Sum *restrict total,
    __global Sum *restrict cosine, __global Sum *restrict sine, __global Sum *restrict square)
{
    const int base = get_global_id(0) * TILE, end = min(pixels, base + TILE);
    for (int t = 0; t < count; ++t) {
        __global const FRAME *restrict frame = frames + (size_t)t * pixels;
        __global FRAME *restrict slot = ring + (size_t)((first + t) % window) * stride;
        const Sum w = basis[6 * t], c = basis[6 * t + 1], s = basis[6 * t + 2];
        const Sum w_gone = basis[6 * t + 3], c_gone = basis[6 * t + 4], s_gone = basis[6 * t + 5];
        for (int p = base; p < end; ++p) {
            const Sum now = frame[p], gone = slot[p], more = w * now, less = w_gone * gone;
            total[p] += more - less;
            cosine[p] += c * now - c_gone * gone;
            sine[p] += s * now - s_gone * gone;
            square[p] += more * now - less * gone;
            slot[p] = frame[p];
        }
    }
}

// One of the frames that are taken side by side, whose samples are added to a pixel's sums a, b, c and d.
#define SIDE(i) \
    __global const FRAME *restrict frame##i = frames + (size_t)place[t + i] * pixels + low; \
    const Narrow cosine##i = basis[3 * (t + i) + 1], sine##i = basis[3 * (t + i) + 2];
#define TAKE(i) \
    now = frame##i[p]; \
    a += now; \
    b += cosine##i * now; \
    c += sine##i * now; \
    d += now * now;
#define PIXELS(take) \
    for (int p = 0; p < width; ++p) { \
        Narrow now, a = totals[p], b = cosines[p], c = sines[p], d = squares[p]; \
        take \
        totals[p] = a; \
        cosines[p] = b; \
        sines[p] = c; \
        squares[p] = d; \
    }

__kernel void correlation_add(
    __global const FRAME *restrict frames, const int count, const int pixels, __global const int *restrict place,
    __global const int *restrict basis, __global long *restrict total, __global long *restrict cosine,
    __global long *restrict sine, __global long *restrict square)
{
    const int base = get_global_id(0) * TILE, end = min(pixels, base + TILE);
    for (int low = base; low < end; low += CHUNK) {
        const int width = min(CHUNK, end - low);
        for (int start = 0; start < count; start += WINDOW) {
            Narrow totals[CHUNK], cosines[CHUNK], sines[CHUNK], squares[CHUNK];
            for (int p = 0; p < width; ++p) totals[p] = cosines[p] = sines[p] = squares[p] = 0;
            const int stop = min(count, start + WINDOW);
            int t = start;
            for (; t + 8 <= stop; t += 8) {
                SIDE(0) SIDE(1) SIDE(2) SIDE(3) SIDE(4) SIDE(5) SIDE(6) SIDE(7)
                PIXELS(TAKE(0) TAKE(1) TAKE(2) TAKE(3) TAKE(4) TAKE(5) TAKE(6) TAKE(7))
            }
            for (; t < stop; ++t) {
                SIDE(0)
                PIXELS(TAKE(0))
            }
            for (int p = 0; p < width; ++p) {
                total[low + p] += totals[p];
                cosine[low + p] += cosines[p];
                sine[low + p] += sines[p];
                square[low + p] += squares[p];
            }
        }
    }
}
#endif

// --- Sums of some pixels' samples less their references -----------------------------------------------------------

enum { TOTAL, COSINE, SINE, SQUARE, SUMS };

typedef struct {
    float reference[CHUNK], high[SUMS][CHUNK], rest[SUMS][CHUNK];
} Sums;

#define GET(sums, k, p) ((Pair){(sums)->high[k][p], (sums)->rest[k][p]})

#define SET(sums, k, p, value) \
    { \
        const Pair pair = value; \
        (sums)->high[k][p] = pair.high; \
        (sums)->rest[k][p] = pair.rest; \
    }

#if BITS < 32
Pair pair_of(const Sum a)
{
#if WIDE
    const int top = (int)(a >> 44), middle = (int)(a >> 22) & 0x3fffff, low = (int)a & 0x3fffff;
    const Pair most = normalised((Pair){top * 17592186044416.0f, middle * 4194304.0f});  // times 2^44 and 2^22
    return normalised(plus(most, (Pair){low, 0}));
#else
    const float high = (float)a;
    return (Pair){high, (float)(a - (Sum)high)};
#endif
}

void centre(
    Sums *restrict sums, const int width, const int frames, const Sum cosines, const Sum sines,
    __global const Sum *restrict total, __global const Sum *restrict cosine, __global const Sum *restrict sine,
    __global const Sum *restrict square)
{
    const float share = 1 / (float)frames;
    for (int p = 0; p < width; ++p) {
        const int reference = (int)((float)total[p] * share + 0.5f);  // any whole number near the mean
        const Sum rest = total[p] - (Sum)reference * frames;
        sums->reference[p] = reference;
        SET(sums, TOTAL, p, pair_of(rest))
        SET(sums, COSINE, p, pair_of(cosine[p] - reference * cosines))
        SET(sums, SINE, p, pair_of(sine[p] - reference * sines))
        SET(sums, SQUARE, p, pair_of(square[p] - reference * (total[p] + rest)))
    }
}
#endif

// The first sample is the reference of all.
void begin(Sums *restrict sums, const int width, __global const FRAME *restrict frame)
{
    for (int p = 0; p < width; ++p) sums->reference[p] = frame[p];
    for (int k = 0; k < SUMS; ++k)
        for (int p = 0; p < width; ++p) sums->high[k][p] = sums->rest[k][p] = 0;
}

void add(
    Sums *restrict sums, const int width, __global const FRAME *restrict frame, const float weight, const float cosine,
    const float sine)
{
    for (int p = 0; p < width; ++p) {
        const float sample = (float)frame[p] - sums->reference[p];
        SET(sums, TOTAL, p, normalised(plus(GET(sums, TOTAL, p), product_of(weight, sample))))
        SET(sums, COSINE, p, normalised(plus(GET(sums, COSINE, p), product_of(cosine, sample))))
        SET(sums, SINE, p, normalised(plus(GET(sums, SINE, p), product_of(sine, sample))))
        const Pair square = product_of(sample, sample);
        Pair part = product_of(weight, square.high);
        part.rest += weight * square.rest;
        SET(sums, SQUARE, p, normalised(plus(GET(sums, SQUARE, p), part)))
    }
}

// --- The fit that sums tell ---------------------------------------------------------------------------------------

#define FIT(i) ((Pair){fit[i], fit[9 + (i)]})
#define ROW(i) normalised(plus(plus(times(FIT(3 * i), a), times(FIT(3 * i + 1), b)), times(FIT(3 * i + 2), c)))

void solve(const Sums *restrict sums, const int width, MAP fit, OUT mean, OUT cosine, OUT sine, OUT residual)
{
    for (int p = 0; p < width; ++p) {
        const Pair a = GET(sums, TOTAL, p), b = GET(sums, COSINE, p), c = GET(sums, SINE, p);
        const Pair x = ROW(0), y = ROW(1), z = ROW(2);
        const Pair fitted = plus(plus(times(x, x), times(y, y)), times(z, z));
        const float left = normalised(minus(GET(sums, SQUARE, p), fitted)).high;
        mean[p] = sums->reference[p] + (fit[18] * x.high + fit[19] * y.high + fit[20] * z.high);
        cosine[p] = fit[22] * y.high + fit[23] * z.high;
        sine[p] = fit[26] * z.high;
        residual[p] = root((left < 0 ? 0 : left) * fit[27]);
    }
}

// --- From whole counts --------------------------------------------------------------------------------------------

#if BITS < 32
__kernel void correlation_solve_counts(
    const int pixels, const int frames, const long cosines, const long sines, __global const Sum *restrict total,
    __global const Sum *restrict cosine, __global const Sum *restrict sine, __global const Sum *restrict square,
    MAP fit, OUT mean, OUT cosine_part, OUT sine_part, OUT residual)
{
    const int base = get_global_id(0) * TILE, end = min(pixels, base + TILE);
    for (int low = base; low < end; low += CHUNK) {
        const int width = min(CHUNK, end - low);
        Sums sums;
        centre(&sums, width, frames, cosines, sines, total + low, cosine + low, sine + low, square + low);
        solve(&sums, width, fit, mean + low, cosine_part + low, sine_part + low, residual + low);
    }
}

#if WIDE
#define AS_LONG(sums, k, p, factor) as_long((float2)(factor * (sums).high[k][p], factor * (sums).rest[k][p]))

__kernel void correlation_convert(
    const int pixels, const int frames, const long cosines, const long sines, const float unit, OUT reference,
    __global Sum *restrict total, __global Sum *restrict cosine, __global Sum *restrict sine,
    __global Sum *restrict square)
{
    const int base = get_global_id(0) * TILE, end = min(pixels, base + TILE);
    for (int low = base; low < end; low += CHUNK) {
        const int width = min(CHUNK, end - low);
        Sums sums;
        centre(&sums, width, frames, cosines, sines, total + low, cosine + low, sine + low, square + low);
        for (int p = 0; p < width; ++p) {
            reference[low + p] = sums.reference[p];
            total[low + p] = AS_LONG(sums, TOTAL, p, 1);
            cosine[low + p] = AS_LONG(sums, COSINE, p, unit);
            sine[low + p] = AS_LONG(sums, SINE, p, unit);
            square[low + p] = AS_LONG(sums, SQUARE, p, 1);
        }
    }
}
#endif
#endif

// --- From any samples ---------------------------------------------------------------------------------------------

#define PAIR(pair) ((Pair){(pair).x, (pair).y})
#define FLOAT2(sums, k, p) (float2)((sums).high[k][p], (sums).rest[k][p])

void load(
    Sums *restrict sums, const int width, MAP reference, __global const float2 *restrict total,
    __global const float2 *restrict cosine, __global const float2 *restrict sine, __global const float2 *restrict square)
{
    for (int p = 0; p < width; ++p) {
        sums->reference[p] = reference[p];
        SET(sums, TOTAL, p, PAIR(total[p]))
        SET(sums, COSINE, p, PAIR(cosine[p]))
        SET(sums, SINE, p, PAIR(sine[p]))
        SET(sums, SQUARE, p, PAIR(square[p]))
    }
}

__kernel void correlation_sum(
    __global const FRAME *restrict frames, const int count, const int pixels, const int fresh,
    __global const int *restrict place, MAP basis, OUT reference, __global float2 *restrict total,
    __global float2 *restrict cosine, __global float2 *restrict sine, __global float2 *restrict square)
{
    const int base = get_global_id(0) * TILE, end = min(pixels, base + TILE);
    for (int low = base; low < end; low += CHUNK) {
        const int width = min(CHUNK, end - low);
        Sums sums;
        if (fresh)
            begin(&sums, width, frames + (size_t)place[0] * pixels + low);
        else
            load(&sums, width, reference + low, total + low, cosine + low, sine + low, square + low);
        for (int t = 0; t < count; ++t)
            add(&sums, width, frames + (size_t)place[t] * pixels + low, basis[3 * t], basis[3 * t + 1],
                basis[3 * t + 2]);
        for (int p = 0; p < width; ++p) {
            reference[low + p] = sums.reference[p];
            total[low + p] = FLOAT2(sums, TOTAL, p);
            cosine[low + p] = FLOAT2(sums, COSINE, p);
            sine[low + p] = FLOAT2(sums, SINE, p);
            square[low + p] = FLOAT2(sums, SQUARE, p);
        }
    }
}

__kernel void correlation_solve_pairs(
    const int pixels, MAP reference, __global const float2 *restrict total, __global const float2 *restrict cosine,
    __global const float2 *restrict sine, __global const float2 *restrict square, MAP fit, OUT mean, OUT cosine_part,
    OUT sine_part, OUT residual)
{
    const int base = get_global_id(0) * TILE, end = min(pixels, base + TILE);
    for (int low = base; low < end; low += CHUNK) {
        const int width = min(CHUNK, end - low);
        Sums sums;
        load(&sums, width, reference + low, total + low, cosine + low, sine + low, square + low);
        solve(&sums, width, fit, mean + low, cosine_part + low, sine_part + low, residual + low);
    }
}

__kernel void correlation_keep(
    __global const FRAME *restrict frames, const int count, const int pixels, const int stride, const int first,
    const int window, __global FRAME *restrict ring)
{
    const int base = get_global_id(0) * TILE, end = min(pixels, base + TILE);
    for (int t = 0; t < count; ++t) {
        __global const FRAME *restrict frame = frames + (size_t)t * pixels;
        __global FRAME *restrict slot = ring + (size_t)((first + t) % window) * stride;
        for (int p = base; p < end; ++p) slot[p] = frame[p];
    }
}

__kernel void correlation_window(
    __global const FRAME *restrict ring, const int count, const int pixels, const int stride,
    __global const int *restrict place, MAP basis, MAP fit, OUT mean, OUT cosine_part, OUT sine_part,
    OUT residual)
{
    const int base = get_global_id(0) * TILE, end = min(pixels, base + TILE);
    for (int low = base; low < end; low += CHUNK) {
        const int width = min(CHUNK, end - low);
        Sums sums;
        begin(&sums, width, ring + (size_t)place[0] * stride + low);
        for (int t = 0; t < count; ++t)
            add(&sums, width, ring + (size_t)place[t] * stride + low, basis[3 * t], basis[3 * t + 1],
                basis[3 * t + 2]);
        solve(&sums, width, fit, mean + low, cosine_part + low, sine_part + low, residual + low);
    }
}
