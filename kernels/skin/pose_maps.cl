// Records of a map for the fit of a motion, from its heights and normals. Specification: pose_maps.py.
//
// TILE     pixels of one work-item: 1 on a GPU, many on a CPU
// SIZE     pixels of a map along each side of a pixel of the records

#include "common.clh"

#if TILE > 1
#define LANES 8  // pixels of a row that are processed at once
#else
#define LANES 1
#endif
#include "lanes.clh"

#ifndef SIZE
#define SIZE 1
#endif

#define UNROLL _Pragma("unroll")
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

typedef float8 __attribute__((aligned(4))) Loose;  // unaligned
typedef F __attribute__((aligned(4))) Lanes;
typedef I __attribute__((aligned(4))) Flags;
typedef float4 __attribute__((aligned(4))) Four;
#define LOAD(values) (*(__global const Lanes *)(values))

#define EACH_PIXEL                                      \
    const int begin = (int)get_global_id(0) * TILE;     \
    for (int p = begin; p < LESSER(begin + TILE, rows * columns); ++p)

// Groups of up to LANES pixels of a row: the first one, p, its row and column, and their count.
#define EACH_GROUP                                                                                       \
    const int begin = (int)get_global_id(0) * TILE, end = LESSER(begin + TILE, rows * columns);         \
    for (int p = begin, row = begin / columns; p < end; ++row)                                           \
        for (int column = p - row * columns, stop = LESSER(end, (row + 1) * columns), count;             \
             p < stop && (count = LESSER(LANES, stop - p), 1); column += count, p += count)

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

// Whether an edge, or a pixel without contact, is within two pixels of a block; each of the maps may be missing.
INLINE int is_near_border(
    __global const uchar *edges, __global const uchar *contact, const int rows, const int columns, const int row,
    const int column)
{
    int is_left_out = 0;
    for (int y = GREATER(row - AROUND, 0); y < LESSER(row + SIZE + AROUND, rows); ++y)
        for (int x = GREATER(column - AROUND, 0); x < LESSER(column + SIZE + AROUND, columns); ++x) {
            if (edges) is_left_out |= edges[y * columns + x] != 0;
            if (contact) is_left_out |= contact[y * columns + x] == 0;
        }
    return is_left_out;
}

#define SHARE (1.0f / (SIZE * SIZE))

// A height; NaN outside of the map. Unless they are means already, it is the mean of SIZE x SIZE heights.
INLINE float height_at(
    MAP height, const int are_means, const int wide, const int rows, const int columns, const int row, const int column)
{
    if (row < 0 || column < 0 || row >= rows || column >= columns) return NAN;
    if (are_means) return height[row * columns + column];
    float mean = 0;
    for (int x = 0; x < SIZE; ++x) {
        float sum = 0;
        for (int y = 0; y < SIZE; ++y) sum += height[(SIZE * row + y) * wide + SIZE * column + x];
        mean += sum;
    }
    return SHARE * mean;
}

// Whether a height is far from its neighbours along all known lines, and from their cubic.
INLINE int is_spike(
    MAP height, const int are_means, const int wide, const int rows, const int columns, const int row,
    const int column, const float here, const float limit)
{
#define HEIGHT_AT(down, right) height_at(height, are_means, wide, rows, columns, row + (down), column + (right))
    const int down[4] = {0, 1, 1, 1}, right[4] = {1, 0, 1, -1};
    const int is_at_border = row == 0 || column == 0 || row == rows - 1 || column == columns - 1;
    int lines = 0;
    for (int i = 0; i < 4; ++i) {
        const int y = down[i], x = right[i];
        const float near = HEIGHT_AT(-y, -x) + HEIGHT_AT(y, x);
        const float bend = fabs(here - 0.5f * near);
        if (bend != bend) continue;
        if (!(bend > limit)) return 0;
        const float far = HEIGHT_AT(-2 * y, -2 * x) + HEIGHT_AT(2 * y, 2 * x);
        if (fabs(here - (4 * near - far) / 6) < 0.5f * bend) return 0;
        ++lines;
    }
    return lines > !is_at_border;
}

// Sums over SIZE rows of a group's values with some parts a pixel, or of the squares of positive values.
INLINE void add_lines(MAP values, const int wide, const int count, const int parts, const int squared, float *line)
{
    if (count == LANES) {
        UNROLL for (int i = 0; i < SIZE * parts; ++i) {
            F sum = 0.0f;
            UNROLL for (int y = 0; y < SIZE; ++y) {
                const F value = LOAD(values + y * wide * parts + LANES * i);
                sum += squared ? (value > 0.0f ? value * value : (F)NAN) : value;
            }
            *(Lanes *)(line + LANES * i) = sum;
        }
    } else {
        for (int i = 0; i < count * SIZE * parts; ++i) {
            line[i] = 0;
            for (int y = 0; y < SIZE; ++y) {
                const float value = values[y * wide * parts + i];
                line[i] += squared ? (value > 0 ? value * value : NAN) : value;
            }
        }
    }
}

#define EVEN(a, b) (F)((a).even, (b).even)
#define ODD(a, b) (F)((a).odd, (b).odd)

// The sums of the SIZE numbers of a line for each pixel of a group.
INLINE F sums_of_line(const float *line)
{
#if LANES == 8 && (SIZE == 2 || SIZE == 4)
    F v[4];
    UNROLL for (int i = 0; i < SIZE; ++i) v[i] = *(const Lanes *)(line + LANES * i);
    const F even = EVEN(v[0], v[1]), odd = ODD(v[0], v[1]);
#if SIZE == 2
    return even + odd;
#else
    const F more_even = EVEN(v[2], v[3]), more_odd = ODD(v[2], v[3]);
    return EVEN(even, more_even) + EVEN(odd, more_odd) + ODD(even, more_even) + ODD(odd, more_odd);
#endif
#else
    float sums[LANES];
    UNROLL for (int lane = 0; lane < LANES; ++lane) {
        sums[lane] = 0;
        UNROLL for (int i = 0; i < SIZE; ++i) sums[lane] += line[SIZE * lane + i];
    }
    return *(const Lanes *)sums;
#endif
}

// The sums of the SIZE vectors of a line for each pixel of a group. One more number of the line is read.
INLINE void vectors_of_line(const float *line, F *x, F *y, F *z)
{
    float4 sums[LANES];
    UNROLL for (int lane = 0; lane < LANES; ++lane) {
        sums[lane] = 0;
        UNROLL for (int i = 0; i < SIZE; ++i) sums[lane] += *(const Four *)(line + 3 * (SIZE * lane + i));
    }
#if LANES > 1
    const float8 a = (float8)(sums[0], sums[1]), b = (float8)(sums[2], sums[3]);
    const float8 c = (float8)(sums[4], sums[5]), d = (float8)(sums[6], sums[7]);
    const F xz = EVEN(a, b), more_xz = EVEN(c, d), yw = ODD(a, b), more_yw = ODD(c, d);
    *x = EVEN(xz, more_xz);
    *y = EVEN(yw, more_yw);
    *z = ODD(xz, more_xz);
#else
    *x = sums[0].x;
    *y = sums[0].y;
    *z = sums[0].z;
#endif
}

// A group's values of which only some are in memory; NAN for the others.
INLINE F some_of(MAP values, const int count)
{
    if (count == LANES) return LOAD(values);
    float some[LANES];
    for (int lane = 0; lane < LANES; ++lane) some[lane] = lane < count ? values[lane] : NAN;
    return *(const Lanes *)some;
}

INLINE void put_some(OUT values, const int count, const F numbers)
{
    if (count == LANES) {
        *(__global Lanes *)values = numbers;
        return;
    }
    float some[LANES];
    *(Lanes *)some = numbers;
    for (int lane = 0; lane < count; ++lane) values[lane] = some[lane];
}

// Whether no height of a group is a spike, by the neighbours in the same row.
INLINE int is_smooth(
    MAP height, const int are_means, const int wide, const int rows, const int columns, const int row,
    const int column, const int count, const F here, const F limit)
{
    if (count < LANES || column == 0 || column + LANES >= columns) return 0;
    float near[LANES + 2];
    near[0] = height_at(height, are_means, wide, rows, columns, row, column - 1);
    *(Lanes *)(near + 1) = here;
    near[LANES + 1] = height_at(height, are_means, wide, rows, columns, row, column + LANES);
    const F bend = here - 0.5f * (*(const Lanes *)near + *(const Lanes *)(near + 2));
    return !any_of(!((bend <= limit) & (-bend <= limit)));
}

// Copies heights; NAN for spikes.
__kernel void pose_spikes(const int rows, const int columns, MAP height, MAP height_sigma, OUT clean)
{
    EACH_GROUP {
        const F here = some_of(height + p, count), limit = SPIKE * some_of(height_sigma + p, count);
        put_some(clean + p, count, here);
        if (is_smooth(height, 1, columns, rows, columns, row, column, count, here, limit)) continue;
        for (int i = 0; i < count; ++i)
            if (is_spike(height, 1, columns, rows, columns, row, column + i, height[p + i], SPIKE * height_sigma[p + i]))
                clean[p + i] = NAN;
    }
}

// Means of SIZE x SIZE heights, and their standard deviations; NAN if one of them is unknown.
__kernel void pose_means(
    const int rows, const int columns, const int wide, MAP height, MAP height_sigma, OUT mean, OUT mean_sigma)
{
    EACH_GROUP {
        const int q = SIZE * (row * wide + column);
        float line[LANES * SIZE];
        add_lines(height + q, wide, count, 1, 0, line);
        put_some(mean + p, count, SHARE * sums_of_line(line));
        if (height_sigma) {
            add_lines(height_sigma + q, wide, count, 1, 1, line);
            put_some(mean_sigma + p, count, SHARE * roots(sums_of_line(line)));
        }
    }
}

__kernel void pose_records(
    const int rows, const int columns, const int high, const int wide, const int spiky, MAP height, MAP height_sigma,
    __global const int *restrict component, BYTES offset_unknown, MAP normals, MAP gradient, MAP normals_sigma,
    BYTES filled, BYTES contact, BYTES edges, OUT records, OUT slopes)
{
    EACH_GROUP {
        const int first = SIZE * (row * wide + column), are_means = SIZE == 1 || gradient;
        const F none = NAN;
        F z, sigma, x, y, upright, square = NOT_COMPARED, variance = FAR;
        if (are_means) {
            z = some_of(height + p, count);
        } else {
            float line[LANES * SIZE];
            add_lines(height + first, wide, count, 1, 0, line);
            z = SHARE * sums_of_line(line);
        }
        if (normals) {
            float line[3 * LANES * SIZE + 1];
            add_lines(normals + 3 * first, wide, count, 3, 0, line);
            vectors_of_line(line, &x, &y, &upright);
            x *= SHARE;
            y *= SHARE;
            upright *= SHARE;
        } else {
            float along[LANES], up[LANES];
            for (int i = 0; i < LANES; ++i) {
                along[i] = i < count ? gradient[2 * (p + i)] : NAN;
                up[i] = i < count ? gradient[2 * (p + i) + 1] : NAN;
            }
            const F a = *(const Lanes *)along, b = *(const Lanes *)up;
            upright = inverse_roots(1.0f + a * a + b * b);
            x = -a * upright;
            y = -b * upright;
        }
        if (normals_sigma) {
            float line[LANES * SIZE];
            add_lines(normals_sigma + first, wide, count, 1, 1, line);
            square = SHARE * SHARE * sums_of_line(line);
            square = square < SHARPEST ? (F)SHARPEST : square;
        }
        int flags[LANES], far[LANES], is_each_smooth = 1;
        for (int i = 0; i < LANES; ++i) flags[i] = far[i] = 0;
        if (height_sigma) {
            if (are_means) {
                sigma = some_of(height_sigma + p, count);
            } else {
                float line[LANES * SIZE];
                add_lines(height_sigma + first, wide, count, 1, 1, line);
                sigma = SHARE * roots(sums_of_line(line));
            }
            const F own = sigma * sigma;
            variance = sigma > 0.0f ? GREATER(own, (F)SHARPEST) : variance;
            is_each_smooth = !spiky
                || is_smooth(height, are_means, wide, rows, columns, row, column, count, z, SPIKE * sigma);
        }
        float heights[LANES], limits[LANES];
        if (!is_each_smooth) {
            *(Lanes *)heights = z;
            *(Lanes *)limits = SPIKE * sigma;
        }
        if (component || filled || edges || contact || !is_each_smooth)
            for (int lane = 0; lane < count; ++lane) {
                if (!is_each_smooth)
                    flags[lane] = is_spike(
                        height, are_means, wide, rows, columns, row, column + lane, heights[lane], limits[lane]);
                const int left = SIZE * (column + lane);
                for (int i = 0, q; i < SIZE * SIZE; ++i) {
                    q = (SIZE * row + i / SIZE) * wide + left + i % SIZE;
                    if (component) far[lane] |= component[q] < 0 || offset_unknown[component[q]];
                    if (filled) flags[lane] |= filled[q] != 0;
                }
                if (edges || contact) flags[lane] |= is_near_border(edges, contact, high, wide, SIZE * row, left);
            }
        const I is_left_out = *(const Flags *)flags != 0, is_unknown = *(const Flags *)far != 0;
        const I used = FINITE(z) & (upright > STEEPEST) & FINITE(square) & !is_left_out;
        float values[5][LANES];
        *(Lanes *)values[0] = used ? x : none;
        *(Lanes *)values[1] = used ? y : none;
        *(Lanes *)values[2] = used ? square : none;
        *(Lanes *)values[3] = used ? z : none;
        *(Lanes *)values[4] = used ? (is_unknown ? (F)FAR : variance) : none;
        for (int i = 0; i < count; ++i) {
            const float rest = values[0][i] != values[0][i] ? NAN : 0;
            *(__global Loose *)(records + NUMBERS * (p + i)) =
                (float8)(values[0][i], values[1][i], values[2][i], values[3][i], values[4][i], rest, rest, rest);
        }
        if (slopes) {
            put_some(slopes + p, count, used ? -x / upright : none);
            put_some(slopes + rows * columns + p, count, used ? -y / upright : none);
        }
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
