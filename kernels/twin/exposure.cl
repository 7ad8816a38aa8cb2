// Conversion of light to counts: levels of each pixel, shot and read noise, quantisation. Specification: exposure.py.
//
// The noise is computed from a counter, without a state: Philox4x32-10 of the seed, the frame and the pixel. One
// counter is used for four pixels, a quarter of the picture apart, so adjacent counters belong to adjacent pixels.
// The code is plain arithmetic without loops: a call of sqrt or log, or an inner loop, would prevent PoCL from
// processing eight counters at once. The polynomials minimise the relative error.
//
// FRAME  type of a sample
// WHOLE  1 if samples are integers: they are rounded, and clipped to 0 ... top
// SHOT   1 for shot noise in addition to the read noise
// TILE   counters of one work-item: 1 on a GPU, many on a CPU
//
// Maps contain 4 * quarter pixels; the last few may be padding.

#pragma OPENCL FP_CONTRACT OFF
#include "common.clh"

#define LOG_2 0.693147181f
#define UNIT 0x1p-31f  // the 31 bits of a uniform number
#define TURN 0x1p-32f  // the 32 bits of a position on a quarter turn
#define NEAREST 0x1.8p23f  // a float of this size has no fractional bits
#define TINY 1e-30f  // without noise there is nothing to transform

// Round i of Philox on the words a to d; the keys are incremented by Weyl's constants.
#define ROUND(i) { \
    const ulong first_product = (ulong)a * 0xD2511F53u, second_product = (ulong)c * 0xCD9E8D57u; \
    a = (uint)(second_product >> 32) ^ b ^ ((uint)seed + i * 0x9E3779B9u); \
    b = (uint)second_product; \
    c = (uint)(first_product >> 32) ^ d ^ ((uint)(seed >> 32) + i * 0xBB67AE85u); \
    d = (uint)first_product; \
}

// Radius of Box and Muller: sqrt(-2 ln u) of a uniform number u in (0, 1].
float radius(const uint word)
{
    const float u = ((float)(int)(word >> 1) + 0.5f) * UNIT;
    const int bits = as_int(u), exponent = (bits - 0x3f3504f3) >> 23;
    const float x = as_float(bits - exponent * 0x800000) - 1.0f;  // u = 2^exponent (1 + x), -0.29 < x < 0.42
    const float slope = 0.99999995f + x * (-0.50000365f + x * (0.33335059f + x * (-0.24969908f
        + x * (0.19900173f + x * (-0.17250848f + x * (0.16222524f - x * 0.10106764f))))));
    return root(-2.0f * ((float)exponent * LOG_2 + x * slope));
}

// A point of the unit circle: 30 bits for its position on a quarter, two for the quarter.
float2 direction(const uint word)
{
    const float quarter = (float)(int)(word << 2) * TURN, square = quarter * quarter;
    const float sine = quarter
        * (1.57079632f + square * (-0.64596346f + square * (0.07968003f - square * 0.00460166f)));
    const float cosine = 0.99999997f
        + square * (-1.23369666f + square * (0.25359495f - square * 0.02039858f));
    const float signed_cosine = as_float(as_int(cosine) ^ (int)(word & 0x80000000u));
    const int upright = (word & 0x40000000u) != 0;
    return (float2)(upright ? sine : signed_cosine, upright ? signed_cosine : sine);
}

// The noise added to a signal; with shot noise the normal number is transformed to the third moment of the
// shot noise.
float noise(const float signal, const float normal, const float read, const float grain)
{
#if SHOT
    const float shot = (signal > 0.0f ? signal : 0.0f) * grain, variance = read * read + shot;
    const float bend = shot * grain / (6.0f * variance + TINY), widest = 0.5f * variance;
    const float square = bend * bend < widest ? bend * bend : widest;
    return root(variance - 2.0f * square) * normal + root(square) * (normal * normal - 1.0f);
#else
    return read * normal;
#endif
}

FRAME quantise(const float counts, const float top)
{
#if WHOLE
    const float held = counts > 0.0f ? counts < top ? counts : top : 0.0f;
    return (FRAME)(int)(held + NEAREST - NEAREST);
#else
    return counts;
#endif
}

#define EXPOSE(pixel, normal) { \
    const int p = pixel; \
    const float signal = span[p] * light[p]; \
    counts[p] = quantise(offset[p] + signal + noise(signal, normal, read, grain), top); \
}

__kernel void expose(
    MAP light, MAP offset, MAP span, const int quarter, const ulong frame, const ulong seed, const float read,
    const float grain, const float top, __global FRAME *restrict counts)
{
    const int begin = get_global_id(0) * TILE, end = min(quarter, begin + TILE);
    for (int n = begin; n < end; ++n) {
        uint a = n, b = 0, c = (uint)frame, d = (uint)(frame >> 32);
        ROUND(0) ROUND(1) ROUND(2) ROUND(3) ROUND(4) ROUND(5) ROUND(6) ROUND(7) ROUND(8) ROUND(9)
        const float near = radius(a), far = radius(c);
        const float2 first = direction(b), second = direction(d);
        EXPOSE(n, near * first.x);
        EXPOSE(n + quarter, near * first.y);
        EXPOSE(n + 2 * quarter, far * second.x);
        EXPOSE(n + 3 * quarter, far * second.y);
    }
}
