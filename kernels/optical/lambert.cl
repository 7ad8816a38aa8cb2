// Least squares of brightness over the directions of the light, frame by frame. Specification: lambert.py.
//
// TILE     pixels of one work-item: 1 on a GPU, many on a CPU
// FRAME    type of a sample

#pragma OPENCL FP_CONTRACT OFF
#include "common.clh"

// Rotates the pair (a, x) so that x becomes 0; ALONG rotates another pair in the same way (Givens).
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
    __global const FRAME *restrict frames, const int count, const int pixels, const int stride, MAP lights, MAP darks,
    const float shadow, const float bright, OUT triangle)
{
    const int low = get_global_id(0) * TILE, end = min(pixels, low + TILE);
    const size_t plane = stride;
    for (int t = 0; t < count; ++t)
        for (int p = low; p < end; ++p) {
            const float sample = frames[(size_t)t * pixels + p], light = sample - darks[p];
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

#define LEAST_PIVOT 1e-3f

__kernel void lambert_normals(
    const int pixels, const int stride, MAP triangle, OUT normals, OUT normals_spread, OUT albedo, OUT albedo_spread, OUT residual,
    __global int *restrict samples)
{
    const int low = get_global_id(0) * TILE, end = min(pixels, low + TILE);
    const size_t plane = stride;
    for (int p = low; p < end; ++p) {
        const float r00 = R(0), r01 = R(1), r02 = R(2), r11 = R(4), r12 = R(5), r22 = R(7), freedom = R(10) - 3;
        const float size = sqrt(r00 * r00 + r01 * r01 + r02 * r02 + r11 * r11 + r12 * r12 + r22 * r22);
        // The inverse of the triangle, whose product with its transpose is the covariance for noise 1.
        const float a = 1 / r00, d = 1 / r11, f = 1 / r22, b = -r01 * a * d, e = -r12 * d * f;
        const float c = -(r01 * e + r02 * f) * a;
        float x = a * R(3) + b * R(6) + c * R(8), y = d * R(6) + e * R(8), z = f * R(8);
        const float length = sqrt(x * x + y * y + z * z);
        const int answered = LESSER(LESSER(r00, r11), r22) > LEAST_PIVOT * size && length > 0 && length < INFINITY;
        x /= length;
        y /= length;
        z /= length;
        const float first = a * x, second = b * x + d * y, third = c * x + e * y + f * z;
        const float radial = first * first + second * second + third * third;
        const float whole = a * a + b * b + c * c + d * d + e * e + f * f;
        normals[3 * p] = answered ? x : NAN;
        normals[3 * p + 1] = answered ? y : NAN;
        normals[3 * p + 2] = answered ? z : NAN;
        normals_spread[p] = answered ? sqrt(whole - radial) / length : NAN;
        albedo[p] = answered ? length : NAN;
        albedo_spread[p] = answered ? sqrt(radial) : NAN;
        residual[p] = freedom > 0 ? sqrt(R(9) / freedom) : NAN;
        samples[p] = R(10);
    }
}
