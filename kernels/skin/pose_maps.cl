// Records of a map for the fit of a motion, from its heights and normals. Specification: pose_maps.py.
//
// TILE     pixels of one work-item: 1 on a GPU, many on a CPU

#include "common.clh"

#define INLINE static inline __attribute__((always_inline))
#define BYTES __global const uchar *restrict
#define FINITE(value) ((value) - (value) == 0.0f)

#define AROUND 2
#define LEAST 7
#define FLAT 1e-3f
#define STRIP 16
#define FAR 1e30f
#define NEAR 1e20f
#define NOT_COMPARED 1e6f
#define SHARPEST 1e-10f
#define VAGUE 100.0f
#define STEEPEST 0.17f
#define SPIKE 8.0f
#define NUMBERS 8
#define SUMMARY 6

#define EACH_PIXEL                                      \
    const int begin = (int)get_global_id(0) * TILE;     \
    for (int p = begin; p < LESSER(begin + TILE, rows * columns); ++p)

// Slopes along x and y of the plane fitted to the valid heights of 5 x 5 pixels; NAN if it is undetermined.
INLINE float2 gradient_at(
    MAP values, const int rows, const int columns, const int p, const float step_x, const float step_y)
{
    const int row = p / columns, column = p % columns;
    const int left = LESSER(AROUND, column), right = LESSER(AROUND, columns - 1 - column);
    const float here = values[p];
    float count = 0, x = 0, y = 0, xx = 0, xy = 0, yy = 0, z = 0, xz = 0, yz = 0;
    for (int below = -LESSER(AROUND, row); below <= LESSER(AROUND, rows - 1 - row); ++below)
        for (int right_of = -left; right_of <= right; ++right_of) {
            const float value = values[p + below * columns + right_of] - here;
            const int defined = value == value;
            const float used = defined ? 1.0f : 0.0f, rise = defined ? value : 0.0f;
            const float i = right_of * used, j = below * used;
            count += used;
            x += i;
            y += j;
            xx += i * right_of;
            xy += i * below;
            yy += j * below;
            z += rise;
            xz += rise * right_of;
            yz += rise * below;
        }
    const float mean_x = x / count, mean_y = y / count;
    xx -= x * mean_x;
    xy -= x * mean_y;
    yy -= y * mean_y;
    xz -= z * mean_x;
    yz -= z * mean_y;
    const float area = xx * yy - xy * xy;
    const int good = count >= LEAST && area > FLAT * count * count;
    return (float2)(good ? (yy * xz - xy * yz) / area / step_x : NAN, good ? -(xx * yz - xy * xz) / area / step_y : NAN);
}

__kernel void pose_gradient(
    const int rows, const int columns, const float step_x, const float step_y, MAP values, OUT gradient)
{
    EACH_PIXEL {
        const float2 slope = gradient_at(values, rows, columns, p, step_x, step_y);
        gradient[2 * p] = slope.x;
        gradient[2 * p + 1] = slope.y;
    }
}

// Whether an edge, or a pixel without contact, is within two pixels; each of the maps may be missing.
INLINE int is_near_border(
    __global const uchar *edges, __global const uchar *contact, const int rows, const int columns, const int p)
{
    const int row = p / columns, column = p % columns;
    int is_left_out = 0;
    for (int y = GREATER(row - AROUND, 0); y <= LESSER(row + AROUND, rows - 1); ++y)
        for (int x = GREATER(column - AROUND, 0); x <= LESSER(column + AROUND, columns - 1); ++x) {
            if (edges) is_left_out |= edges[y * columns + x] != 0;
            if (contact) is_left_out |= contact[y * columns + x] == 0;
        }
    return is_left_out;
}

INLINE float height_at(MAP height, const int rows, const int columns, const int row, const int column)
{
    return row >= 0 && column >= 0 && row < rows && column < columns ? height[row * columns + column] : NAN;
}

// Copies heights; NAN for spikes, which are far from their neighbours along all known lines, and from their cubic.
__kernel void pose_spikes(const int rows, const int columns, MAP height, MAP height_sigma, OUT clean)
{
    const int down[4] = {0, 1, 1, 1}, right[4] = {1, 0, 1, -1};
    EACH_PIXEL {
        const int row = p / columns, column = p % columns;
        const float limit = SPIKE * height_sigma[p], here = height[p];
        const int is_at_border = row == 0 || column == 0 || row == rows - 1 || column == columns - 1;
        int lines = 0, far = 0;
        for (int i = 0; i < 4; ++i) {
            const int y = down[i], x = right[i];
            const float near = height_at(height, rows, columns, row - y, column - x) + height_at(height, rows, columns, row + y, column + x);
            const float bend = fabs(here - 0.5f * near);
            if (!(bend > limit)) {
                lines += bend == bend;
                continue;
            }
            const float wide = height_at(height, rows, columns, row - 2 * y, column - 2 * x) + height_at(height, rows, columns, row + 2 * y, column + 2 * x);
            ++lines;
            far += !(fabs(here - (4 * near - wide) / 6) < 0.5f * bend);
        }
        clean[p] = lines > !is_at_border && far == lines ? NAN : here;
    }
}

__kernel void pose_records(
    const int rows, const int columns, MAP height, MAP height_sigma, __global const int *restrict component,
    BYTES offset_unknown, MAP normals, MAP gradient, MAP normals_sigma, BYTES filled, BYTES contact, BYTES edges,
    OUT records, OUT slopes)
{
    EACH_PIXEL {
        float x, y, upright, square = NOT_COMPARED, variance = FAR;
        if (normals) {
            x = normals[3 * p];
            y = normals[3 * p + 1];
            upright = normals[3 * p + 2];
        } else {
            const float a = gradient[2 * p], b = gradient[2 * p + 1];
            upright = 1.0f / sqrt(1.0f + a * a + b * b);
            x = -a * upright;
            y = -b * upright;
        }
        if (normals_sigma) square = normals_sigma[p] > 0 ? GREATER(normals_sigma[p] * normals_sigma[p], SHARPEST) : NAN;
        if (height_sigma && height_sigma[p] > 0) variance = GREATER(height_sigma[p] * height_sigma[p], SHARPEST);
        if (component && (component[p] < 0 || offset_unknown[component[p]])) variance = FAR;
        int used = FINITE(height[p]) && upright > STEEPEST && FINITE(square);
        if (filled) used = used && !filled[p];
        if (edges || contact) used = used && !is_near_border(edges, contact, rows, columns, p);
        const float values[NUMBERS] = {x, y, square, height[p], variance, 0, 0, 0};
        for (int i = 0; i < NUMBERS; ++i) records[NUMBERS * p + i] = used ? values[i] : NAN;
        slopes[p] = used ? -x / upright : NAN;
        slopes[rows * columns + p] = used ? -y / upright : NAN;
    }
}

__kernel void pose_curvature(
    const int rows, const int columns, const float step_x, const float step_y, MAP slopes, OUT records)
{
    EACH_PIXEL {
        const float2 across = gradient_at(slopes, rows, columns, p, step_x, step_y);
        const float2 up = gradient_at(slopes + rows * columns, rows, columns, p, step_x, step_y);
        OUT record = records + NUMBERS * p;
        record[5] = across.x;
        record[6] = (across.y + up.x) / 2;
        record[7] = up.y;
        if (!FINITE(across.x))
            for (int i = 0; i < NUMBERS; ++i) record[i] = NAN;
    }
}

__kernel void pose_halve(const int rows, const int columns, const int wide, MAP fine, OUT records)
{
    EACH_PIXEL {
        MAP first = fine + NUMBERS * (p / columns * 2 * wide + p % columns * 2);
        MAP below = first + NUMBERS * wide;
        for (int i = 0; i < NUMBERS; ++i) {
            const float mean = (first[i] + first[NUMBERS + i] + (below[i] + below[NUMBERS + i])) / 4;
            records[NUMBERS * p + i] = i == 2 || i == 4 ? mean / 4 : mean;
        }
    }
}

// For strips of a row, one after the other: SUMMARY numbers.
__kernel void pose_summary(
    const int rows, const int columns, const float x0, const float y0, const float step_x, const float step_y,
    MAP records, OUT summary)
{
    const int across = (columns + STRIP - 1) / STRIP, strip = get_global_id(0), row = strip / across;
    if (row >= rows) return;
    const int start = strip % across * STRIP, end = LESSER(start + STRIP, columns);
    const float y = y0 - row * step_y;
    float count = 0, compared = 0, x = 0, z = 0, spread = 0;
    for (int column = start; column < end; ++column) {
        MAP record = records + NUMBERS * (row * columns + column);
        if (record[0] != record[0]) continue;
        count += 1;
        compared += record[2] < VAGUE || record[4] < NEAR;
        x += x0 + column * step_x;
        z += record[3];
    }
    const float per_count = 1 / GREATER(count, 1.0f), mean_x = per_count * x, mean_z = per_count * z;
    for (int column = start; column < end; ++column) {
        MAP record = records + NUMBERS * (row * columns + column);
        if (record[0] != record[0]) continue;
        const float i = x0 + column * step_x - mean_x, k = record[3] - mean_z;
        spread += i * i + k * k;
    }
    const float values[SUMMARY] = {count, compared, x, count * y, z, spread};
    for (int i = 0; i < SUMMARY; ++i) summary[SUMMARY * strip + i] = values[i];
}
