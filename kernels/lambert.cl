// Least squares of brightness over the directions of the light, frame by frame. Specification: lambert.py.
//
// TILE     pixels of one work-item; 1 where an item is a lane, many where it is a core's loop
// FRAME    type of a sample

#pragma OPENCL FP_CONTRACT OFF
#include "common.clh"

// Turns the pair (a, x) so that x becomes 0; ALONG turns another pair in the same way (Givens).
#define TURN(a, x)                                                                          \
    do {                                                                                    \
        const float square = (a) * (a) + (x) * (x), inverse = inverse_root(square);         \
        along = (x) == 0 ? 1 : (a) * inverse;                                               \
        across = (x) == 0 ? 0 : (x) * inverse;                                              \
        (a) = (x) == 0 ? (a) : square * inverse;                                            \
    } while (0)
#define ALONG(b, y)                                                                         \
    do {                                                                                    \
        const float kept = (b);                                                             \
        (b) = along * kept + across * (y);                                                  \
        (y) = along * (y) - across * kept;                                                  \
    } while (0)

#define R(k) triangle[(k) * plane + p]

__kernel void lambert_add(
    __global const FRAME *restrict frames, const int count, const int pixels, MAP lights, const int fresh,
    MAP darks, const int dark_step, const float shadow, const float bright, OUT triangle)
{
    const int low = get_global_id(0) * TILE, end = min(pixels, low + TILE);
    const size_t plane = pixels;
    if (fresh)
        for (int p = low; p < end; ++p)
            for (int k = 0; k < 11; ++k) R(k) = 0;
    for (int t = 0; t < count; ++t)
        for (int p = low; p < end; ++p) {
            const float sample = frames[t * plane + p], light = sample - darks[p * dark_step];
            const int seen = (light > shadow) & (sample < bright);
            float x = seen ? lights[3 * t] : 0, y = seen ? lights[3 * t + 1] : 0, z = seen ? lights[3 * t + 2] : 0;
            float e = seen ? light : 0, along, across;
            TURN(R(0), x);
            ALONG(R(1), y);
            ALONG(R(2), z);
            ALONG(R(3), e);
            TURN(R(4), y);
            ALONG(R(5), z);
            ALONG(R(6), e);
            TURN(R(7), z);
            ALONG(R(8), e);
            R(9) += e * e;
            R(10) += seen;
        }
}
