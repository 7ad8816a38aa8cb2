// Least squares of brightness over the directions of the light, frame by frame. Specification: lambert.py.
//
// TILE     pixels of one work-item: 1 on a GPU, many on a CPU
// FRAME    type of a sample

#pragma OPENCL FP_CONTRACT OFF
#include "common.clh"

// A block is small enough for its state to stay in the nearest cache.
#define BLOCK (TILE < 128 ? TILE : 128)

#define STATE(k) triangle[(k) * plane + p]

// Eliminates x, the number in column i of a row with a weight (Gentleman 1973). OTHER does the same to another column.
#define ELIMINATE(i, x)                                                                      \
    const float x##_new = size[i][p] + weight * (x) * (x), x##_inverse = 1 / x##_new;        \
    const float x##_keep = x##_new > 0 ? size[i][p] * x##_inverse : 1;                       \
    const float x##_add = x##_new > 0 ? weight * (x) * x##_inverse : 0;                      \
    size[i][p] = x##_new;                                                                    \
    weight *= x##_keep;
#define OTHER(x, r, y)                                                                       \
    do {                                                                                     \
        const float before = (r);                                                            \
        (r) = x##_keep * before + x##_add * (y);                                             \
        (y) -= (x) * before;                                                                 \
    } while (0)

__kernel void lambert_add(
    __global const FRAME *restrict frames, const int count, const int pixels, const int stride, MAP lights, MAP darks,
    const int first, const float shadow, const float bright, OUT triangle)
{
    const int low = get_global_id(0) * TILE, end = min(pixels, low + TILE);
    const size_t plane = stride;
    for (int base = low; base < end; base += BLOCK) {
        const int width = min(BLOCK, end - base);
        // Squares of the diagonal, what is above it by rows, the right-hand side, residual sum, number of samples.
        float size[3][BLOCK], above[3][BLOCK], right[3][BLOCK], residual[BLOCK], samples[BLOCK], dark[BLOCK];
        for (int k = 0; k < 3; ++k)
            for (int i = 0; i < width; ++i) size[k][i] = above[k][i] = right[k][i] = 0;
        for (int i = 0; i < width; ++i) residual[i] = samples[i] = 0;
        for (int i = 0; i < width; ++i) dark[i] = darks[base + i];
        if (first > 0) {
            for (int k = 0; k < 3; ++k)
                for (int i = 0, p = base; i < width; ++i, ++p) {
                    size[k][i] = STATE(k);
                    above[k][i] = STATE(3 + k);
                    right[k][i] = STATE(6 + k);
                }
            for (int i = 0, p = base; i < width; ++i, ++p) {
                residual[i] = STATE(9);
                samples[i] = STATE(10);
            }
        }
        for (int t = 0; t < count; ++t) {
            const float light_x = lights[3 * t], light_y = lights[3 * t + 1], light_z = lights[3 * t + 2];
            __global const FRAME *restrict frame = frames + (size_t)t * pixels + base;
            for (int p = 0; p < width; ++p) {
                const float sample = frame[p], light = sample - dark[p];
                const int usable = (light > shadow) & (sample < bright);
                const float x = light_x;
                float y = light_y, z = light_z, e = usable ? light : 0, weight = usable ? 1 : 0;
                ELIMINATE(0, x)
                OTHER(x, above[0][p], y);
                OTHER(x, above[1][p], z);
                OTHER(x, right[0][p], e);
                ELIMINATE(1, y)
                OTHER(y, above[2][p], z);
                OTHER(y, right[1][p], e);
                ELIMINATE(2, z)
                OTHER(z, right[2][p], e);
                residual[p] += weight * e * e;
                samples[p] += usable;
            }
        }
        for (int k = 0; k < 3; ++k)
            for (int i = 0, p = base; i < width; ++i, ++p) {
                STATE(k) = size[k][i];
                STATE(3 + k) = above[k][i];
                STATE(6 + k) = right[k][i];
            }
        for (int i = 0, p = base; i < width; ++i, ++p) {
            STATE(9) = residual[i];
            STATE(10) = samples[i];
        }
    }
}

#define LEAST_PIVOT 1e-3f

__kernel void lambert_normals(
    const int pixels, const int stride, MAP triangle, OUT normals, OUT normals_sigma, OUT albedo, OUT albedo_sigma, OUT residual,
    __global int *restrict samples)
{
    const int low = get_global_id(0) * TILE, end = min(pixels, low + TILE);
    const size_t plane = stride;
    for (int p = low; p < end; ++p) {
        const float r00 = sqrt(STATE(0)), r11 = sqrt(STATE(1)), r22 = sqrt(STATE(2)), freedom = STATE(10) - 3;
        const float r01 = r00 * STATE(3), r02 = r00 * STATE(4), r12 = r11 * STATE(5);
        const float r03 = r00 * STATE(6), r13 = r11 * STATE(7), r23 = r22 * STATE(8);
        const float size = sqrt(r00 * r00 + r01 * r01 + r02 * r02 + r11 * r11 + r12 * r12 + r22 * r22);
        // The inverse of the triangle, whose product with its transpose is the covariance for noise 1.
        const float a = 1 / r00, d = 1 / r11, f = 1 / r22, b = -r01 * a * d, e = -r12 * d * f;
        const float c = -(r01 * e + r02 * f) * a;
        float x = a * r03 + b * r13 + c * r23, y = d * r13 + e * r23, z = f * r23;
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
        normals_sigma[p] = answered ? sqrt(whole - radial) / length : NAN;
        albedo[p] = answered ? length : NAN;
        albedo_sigma[p] = answered ? sqrt(radial) : NAN;
        residual[p] = freedom > 0 ? sqrt(STATE(9) / freedom) : NAN;
        samples[p] = STATE(10);
    }
}

__kernel void lambert_scale(
    const int pixels, MAP residual, __global const int *restrict samples, MAP noise, const int noise_step, MAP limits,
    OUT normals_sigma, OUT albedo_sigma)
{
    const int low = get_global_id(0) * TILE, end = min(pixels, low + TILE);
    for (int p = low; p < end; ++p) {
        const float deviation = noise[noise_step * p], ratio = residual[p] / deviation;
        const int freedom = GREATER(samples[p] - 3, 0);
        const float scale = deviation * (ratio > limits[freedom] ? ratio : 1);
        normals_sigma[p] *= scale;
        albedo_sigma[p] *= scale;
    }
}

__kernel void lambert_widen(
    const int pixels, MAP normals, MAP albedo, MAP tables, const int cells, const float noise, const float usual,
    OUT normals_sigma, OUT albedo_sigma)
{
    const int low = get_global_id(0) * TILE, end = min(pixels, low + TILE), side = cells + 1, size = side * side;
    for (int p = low; p < end; ++p) {
        const float length = albedo[p], inverse = 1 / length;
        if (!(length > 0)) continue;
        const int row = (normals[3 * p] + 1) * (0.5f * cells) + 0.5f;
        const int column = (normals[3 * p + 1] + 1) * (0.5f * cells) + 0.5f;
        MAP cell = tables + clamp(row, 0, cells) * side + clamp(column, 0, cells);
        const float ratio = (noise * noise + cell[6 * size]) / (usual * usual), factor = GREATER(ratio, 1);
        const float normal = cell[0] + (cell[size] + cell[2 * size] * inverse) * inverse;
        const float radial = cell[3 * size] + (cell[4 * size] + cell[5 * size] * inverse) * inverse;
        const float first = normals_sigma[p], second = albedo_sigma[p];
        normals_sigma[p] = sqrt(first * first * factor + GREATER(normal, 0));
        albedo_sigma[p] = sqrt(second * second * factor + GREATER(radial, 0) * length * length);
    }
}
