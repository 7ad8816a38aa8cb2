// Displacement of a texture: spline of a frame, interpolation of the displaced frame, and least squares in windows.
// Specification: displacement.py.
//
// FRAME   type of a sample
// TILE    pixels of one work-item: 1 on a GPU, many on a CPU
// NODES   adjacent nodes of a row of one work-item: 1 on a GPU, a multiple of 8 on a CPU
// WINDOW  pixels of a window's side
// STEP    pixels from a node to the next one
// TOP     value of a saturated sample; undefined for floats
//
// The windows of adjacent nodes overlap. What is summed is therefore summed over the columns of windows first, from
// which the sums of all windows of a work-item are computed.

#pragma OPENCL FP_CONTRACT OFF

#include "common.clh"

#if NODES > 1
#define LANES 8  // columns, pixels or nodes processed together
#else
#define LANES 1
#endif
#include "lanes.clh"

typedef F __attribute__((aligned(4))) Loose;  // unaligned
#define LOAD(from) (*(__global const Loose *)(from))
#define STORE(to, values) (*(__global Loose *)(to) = (values))
#define KEPT(from) (*(const Loose *)(from))
#define LANE(values, i) (((float *)&(values))[i])
#define PLACE_OF(values, i) (((const int *)&(values))[i])
#if LANES > 1
#define NUMBERS (I)(0, 1, 2, 3, 4, 5, 6, 7)
#else
#define NUMBERS 0
#endif

#define FOUR(from) (*(__global const Four *)(from))
typedef float4 __attribute__((aligned(4))) Four;  // unaligned

#define TAPS 8
#define MARGIN (TAPS + 4)
#define PARAMETERS 10
#define AFFINE 6  // number of affine parameters
#define PACKED (PARAMETERS * (PARAMETERS + 1) / 2)  // elements of a symmetric matrix
#define MOST 1e5f  // maximum magnitude of an inverse matrix
#define MOST_CHANGE 1.5f  // pixels in an iteration

#define STRIP (TILE < 256 ? TILE : 256)  // pixels of a row that are processed together

// Positions beyond an end are mirrored.
#define MIRROR(place, length) \
    ((place) < 0 ? -(place) : (place) < (length) ? (place) : 2 * ((length) - 1) - (place))

// The same as often as necessary: a margin may be wider than a picture.
int reflected(const int place, const int length)
{
    const int period = 2 * length - 2, rest = (place < 0 ? -place : place) % period;
    return rest < length ? rest : period - rest;
}

// sqrt(3) times the powers of the spline's pole, sqrt(3) - 2. `BOTH(k)` is the sum of the two samples k away.
#define FILTERED(middle, BOTH)                                                                                      \
    (1.7320508f * (middle) - 0.46410162f * BOTH(1) + 0.12435565f * BOTH(2) - 0.033320997f * BOTH(3)                 \
        + 0.0089283345f * BOTH(4) - 0.0023923402f * BOTH(5) + 6.4102660e-4f * BOTH(6) - 1.7176256e-4f * BOTH(7)     \
        + 4.6023640e-5f * BOTH(8))
typedef WIDE(FRAME) __attribute__((aligned(sizeof(FRAME)))) Samples;  // unaligned
#define SUM_OF_uchar int
#define SUM_OF_ushort int
#define SUM_OF_float float
typedef WIDE(JOIN(SUM_OF_, FRAME)) Sums;  // whole numbers are added first, which saves conversions
#define SAMPLES(k) CONVERT(*(__global const Samples *)(frame + line[TAPS + (k)] + x), Sums)
#define ABOVE_AND_BELOW(k) CONVERT(SAMPLES(-(k)) + SAMPLES(k), F)
#define ON_BOTH_SIDES(k) (KEPT(at - (k)) + KEPT(at + (k)))

__kernel void displacement_spline(
    const int rows, const int columns, const int top, const int bottom, const int left, const int right,
    __global const FRAME *restrict frame, OUT coefficients)
{
    const int pieces = (right - left + TILE - 1) / TILE, y = top + get_global_id(0) / pieces;
    if (y >= bottom) return;
    const int first = left + (get_global_id(0) - (y - top) * pieces) * TILE, end = min(first + TILE, right);
    // A strip is not shorter than others, as mirrored samples are copied within it.
    const int strips = (end - first + STRIP - 1) / STRIP, strip = (end - first + strips - 1) / strips;
    OUT out = coefficients + y * (columns + 2 * MARGIN);
    int line[2 * TAPS + 1];
    for (int k = 0; k <= 2 * TAPS; ++k) line[k] = reflected(y - MARGIN + k - TAPS, rows) * columns;
    for (int base = first; base < end; base += strip) {
        // Filtered along the columns of the picture, then along the row.
        const int size = min(strip, end - base), start = base - MARGIN - TAPS, stop = start + size + 2 * TAPS;
        const int low = LIMITED(start, 0, columns), count = LIMITED(stop, 0, columns) - low;
        float along[STRIP + 2 * TAPS + LANES];
        float *inside = along + low - start;
        for (int x = low; x < low + count; x += LANES) {
            const F value = FILTERED(CONVERT(SAMPLES(0), F), ABOVE_AND_BELOW);
            *(Loose *)(inside + x - low) = value;
        }
        for (int side = 0; side < 2; ++side)
            for (int place = side ? max(low + count, start) : start; place < (side ? stop : min(low, stop)); ++place) {
                const int x = columns > MARGIN + TAPS ? MIRROR(place, columns) : reflected(place, columns);
                float value;
                if (x >= low && x < low + count) value = inside[x - low];
                else {
                    const F values = FILTERED(CONVERT(SAMPLES(0), F), ABOVE_AND_BELOW);
                    value = LANE(values, 0);
                }
                along[place - start] = value;
            }
        for (int i = 0; i < size; i += LANES) {
            const float *at = along + i + TAPS;
            const F value = FILTERED(KEPT(at), ON_BOTH_SIDES);
            if (i + LANES <= size) STORE(out + base + i, value);
            else
                for (int k = 0; k < size - i; ++k) out[base + i + k] = LANE(value, k);
        }
    }
}

#ifdef TOP
#define KNOWN(sample) ((sample) != TOP)
#else
#define KNOWN(sample) ((sample) - (sample) == 0)
#endif

#define FIRST_OF_MEAN (-(WINDOW / 2))

__kernel void displacement_across(
    const int rows, const int columns, __global const FRAME *restrict frame, OUT sums, OUT counts)
{
    const int pieces = (columns + TILE - 1) / TILE, row = get_global_id(0) / pieces;
    if (row >= rows) return;
    const int first = (get_global_id(0) - row * pieces) * TILE, end = min(first + TILE, columns);
    __global const FRAME *restrict samples = frame + row * columns;
    for (int base = first; base < end; base += STRIP) {
        const int size = min(STRIP, end - base);
        float value[STRIP + WINDOW], known[STRIP + WINDOW], sum[STRIP], count[STRIP];
        for (int i = 0; i < size + WINDOW - 1; ++i) {
            const FRAME sample = samples[MIRROR(base + i + FIRST_OF_MEAN, columns)];
            const int defined = KNOWN(sample);
            value[i] = defined ? (float)sample : 0;
            known[i] = defined;
        }
        for (int i = 0; i < size; ++i) sum[i] = count[i] = 0;
        for (int k = 0; k < WINDOW; ++k) {
            for (int i = 0; i < size; ++i) sum[i] += value[i + k];
            for (int i = 0; i < size; ++i) count[i] += known[i + k];
        }
        for (int i = 0; i < size; ++i) sums[row * columns + base + i] = sum[i];
        for (int i = 0; i < size; ++i) counts[row * columns + base + i] = count[i];
    }
}

#define BESIDES(at) ((at)[1] - (at)[-1])
#define ABOVES(at) ((at)[stride] - (at)[-stride])

__kernel void displacement_planes(
    const int rows, const int columns, const int halo, __global const FRAME *restrict frame, MAP coefficients, MAP sums,
    MAP counts, OUT planes, OUT difference)
{
    const int width = columns + 2 * halo, height = rows + 2 * halo, plane = width * height;
    const int pieces = (width + TILE - 1) / TILE, y = get_global_id(0) / pieces;
    if (y >= height) return;
    const int row = y - halo, stride = columns + 2 * MARGIN;
    const int first = (get_global_id(0) - y * pieces) * TILE, end = min(first + TILE, width);
    OUT out = planes + y * width;
    OUT out_x = out + plane;
    OUT out_y = out_x + plane;
    OUT texture = out_y + plane;
    for (int x = first; x < end; ++x) out[x] = NAN;
    for (int x = first; x < end; ++x) out_x[x] = out_y[x] = texture[x] = 0;
    for (int x = first; x < end; ++x) difference[y * width + x] = difference[plane + y * width + x] = 0;
    if (row < 0 || row >= rows) return;
    for (int base = max(first - halo, 0); base < min(end - halo, columns); base += STRIP) {
        const int size = min(STRIP, min(end - halo, columns) - base);
        float sum[STRIP], count[STRIP];
        for (int i = 0; i < size; ++i) sum[i] = count[i] = 0;
        for (int k = FIRST_OF_MEAN; k < FIRST_OF_MEAN + WINDOW; ++k) {
            const int other = MIRROR(row + k, rows) * columns + base;
            for (int i = 0; i < size; ++i) sum[i] += sums[other + i];
            for (int i = 0; i < size; ++i) count[i] += counts[other + i];
        }
        __global const FRAME *restrict samples = frame + row * columns + base;
        MAP at = coefficients + (row + MARGIN) * stride + base + MARGIN;
        const int x = base + halo;
        for (int i = 0; i < size; ++i) {
            const FRAME sample = samples[i];
            const int defined = KNOWN(sample);
            const float along_x = (BESIDES(at + i - stride) + 4 * BESIDES(at + i) + BESIDES(at + i + stride)) * (1.0f / 12);
            const float along_y = (ABOVES(at + i - 1) + 4 * ABOVES(at + i) + ABOVES(at + i + 1)) * (1.0f / 12);
            const float mean = sum[i] / count[i];
            out[x + i] = defined ? (float)sample : NAN;
            out_x[x + i] = defined ? along_x : 0;
            out_y[x + i] = defined ? along_y : 0;
            texture[x + i] = defined ? sample - mean : 0;
        }
    }
}

// Weights of the coefficients at -1, 0, 1 and 2, for a position from 0 to 1.
#define CUBIC(w, part) { \
    const F rest = 1 - (part); \
    w##0 = rest * rest * rest * (1.0f / 6); \
    w##1 = 2.0f / 3 - 0.5f * (part) * (part) * (2 - (part)); \
    w##2 = 2.0f / 3 - 0.5f * rest * rest * (2 - rest); \
    w##3 = (part) * (part) * (part) * (1.0f / 6); \
}

// Variance of the interpolated value for noise of variance 1; the constants are CORRELATION.
#define NOISE_GAIN(w) (CORRELATION0 * (w##0 * w##0 + w##1 * w##1 + w##2 * w##2 + w##3 * w##3) \
    + 2 * CORRELATION1 * (w##0 * w##1 + w##1 * w##2 + w##2 * w##3) \
    + 2 * CORRELATION2 * (w##0 * w##2 + w##1 * w##3) + 2 * CORRELATION3 * (w##0 * w##3))

#define CORRELATION0 3.46410162f
#define CORRELATION1 -1.73205081f
#define CORRELATION2 0.679491924f
#define CORRELATION3 -0.239782972f

#define LINE(at, w) (w##0 * LOAD(at) + w##1 * LOAD((at) + 1) + w##2 * LOAD((at) + 2) + w##3 * LOAD((at) + 3))

// A frame at positions inside it, which become the fractions of a pixel.
F interpolate(MAP coefficients, const int stride, F *x, F *y)
{
    const I west = CONVERT(*x, I), north = CONVERT(*y, I);
    *x -= CONVERT(west, F);
    *y -= CONVERT(north, F);
    F x0, x1, x2, x3, y0, y1, y2, y3, value;
    CUBIC(x, *x)
    CUBIC(y, *y)
    const I place = (north - 1 + MARGIN) * stride + west - 1 + MARGIN;
    const int begin = PLACE_OF(place, 0);
    if (!any_of(place != begin + NUMBERS)) {  // neighbours go to neighbours
        MAP at = coefficients + begin;
        return y0 * LINE(at, x) + y1 * LINE(at + stride, x) + y2 * LINE(at + 2 * stride, x) + y3 * LINE(at + 3 * stride, x);
    }
    for (int i = 0; i < LANES; ++i) {
        MAP at = coefficients + PLACE_OF(place, i);
        const float4 line = LANE(y0, i) * FOUR(at) + LANE(y1, i) * FOUR(at + stride)
            + LANE(y2, i) * FOUR(at + 2 * stride) + LANE(y3, i) * FOUR(at + 3 * stride);
        LANE(value, i) = LANE(x0, i) * line.x + LANE(x1, i) * line.y + LANE(x2, i) * line.z + LANE(x3, i) * line.w;
    }
    return value;
}

// Variance of the interpolated value for noise of variance 1, at fractions of a pixel.
F interpolated_noise(const F x, const F y)
{
    F x0, x1, x2, x3, y0, y1, y2, y3;
    CUBIC(x, x)
    CUBIC(y, y)
    return NOISE_GAIN(x) * NOISE_GAIN(y);
}

// The window of the first node starts at the pixel FIRST. The node is at its centre, LAG before the pixel OFFSET.
#define FIRST ((STEP - WINDOW - ((STEP - WINDOW) & 1)) / 2)
#define OFFSET (FIRST + WINDOW / 2)
#define LAG (WINDOW % 2 ? 0.0f : 0.5f)
#define NODE_OF(pixel) (((pixel) - OFFSET + STEP) / STEP - 1)  // the node before it; -1 before the first one

// Executes statements for the pixels from `low` to `high` between the node and the next one. Pixel i is the
// fraction `part` of the way to the next one.
#define BETWEEN_NODES(node, low, high, statements)                                                   \
    {                                                                                                \
        const int start = OFFSET + (node) * STEP;                                                    \
        if (start >= (low) && start + STEP <= (high))                                                \
            for (int k = 0; k < STEP; ++k) {                                                         \
                const int i = start + k;                                                             \
                const float part = (k + LAG) * (1.0f / STEP);                                        \
                statements                                                                           \
            }                                                                                        \
        else                                                                                         \
            for (int i = GREATER(start, low); i < LESSER(start + STEP, high); ++i) {                 \
                const float part = (i - start + LAG) * (1.0f / STEP);                                \
                statements                                                                           \
            }                                                                                        \
    }

#define SPAN ((STRIP + STEP - 1) / STEP + 2)  // nodes around a strip

// The fraction of the way from a node to the next one, of a row.
#define ROW_PART(row, node) (((row) - OFFSET - (node) * STEP + LAG) * (1.0f / STEP))

__kernel void displacement_warp(
    const int rows, const int columns, const int node_rows, const int node_columns, const int halo, MAP coefficients,
    MAP planes, MAP field, OUT difference)
{
    const int pieces = (columns + TILE - 1) / TILE, row = get_global_id(0) / pieces;
    if (row >= rows) return;
    const int first = (get_global_id(0) - row * pieces) * TILE, end = min(first + TILE, columns);
    const int width = columns + 2 * halo, plane = width * (rows + 2 * halo), stride = columns + 2 * MARGIN;
    const int nodes = node_rows * node_columns, node_row = NODE_OF(row);
    const float part_row = ROW_PART(row, node_row);
    MAP upper = field + LIMITED(node_row, 0, node_rows - 1) * node_columns;
    MAP lower = field + LIMITED(node_row + 1, 0, node_rows - 1) * node_columns;
    for (int base = first; base < end; base += STRIP) {
        const int limit = min(base + STRIP, end), node = NODE_OF(base), last = NODE_OF(limit - 1);
        float right[STRIP + LANES], down[STRIP + LANES], right_of[SPAN + 1], down_of[SPAN + 1];
        for (int n = node; n <= last + 1; ++n) {
            const int k = LIMITED(n, 0, node_columns - 1);
            right_of[n - node] = (1 - part_row) * upper[k] + part_row * lower[k];
            down_of[n - node] = (1 - part_row) * upper[nodes + k] + part_row * lower[nodes + k];
        }
        for (int n = node; n <= last; ++n)
            BETWEEN_NODES(n, base, limit,
                right[i - base] = (1 - part) * right_of[n - node] + part * right_of[n - node + 1];
                down[i - base] = (1 - part) * down_of[n - node] + part * down_of[n - node + 1];)
        for (int i = limit - base; i < STRIP + LANES; ++i) right[i] = down[i] = 0;
        for (int column = base; column < limit; column += LANES) {
            const F to_right = KEPT(right + column - base), to_down = KEPT(down + column - base);
            F x = CONVERT(column + NUMBERS, F) + to_right, y = row + to_down;
            const I inside = (x >= 0) & (x <= columns - 1) & (y >= 0) & (y <= rows - 1);
            x = inside ? x : 0;
            y = inside ? y : 0;
            const F value = interpolate(coefficients, stride, &x, &y);
            const int p = (row + halo) * width + column + halo;
            const F counts = LOAD(planes + p), along_x = LOAD(planes + plane + p), along_y = LOAD(planes + 2 * plane + p);
            const I measured = counts - counts == 0;
            const F deviation = counts - value + along_x * to_right + along_y * to_down;
            const F differs = measured ? (inside ? deviation : (F)NAN) : 0;
            const F variance = measured ? 1 + interpolated_noise(x, y) : 0;
            if (column + LANES <= limit) {
                STORE(difference + p, differs);
                STORE(difference + plane + p, variance);
            } else {
                for (int i = 0; i < limit - column; ++i) difference[p + i] = LANE(differs, i);
                for (int i = 0; i < limit - column; ++i) difference[plane + p + i] = LANE(variance, i);
            }
        }
    }
}

// Keys' cubic from the nodes at -1, 0, 1 and 2 in addition to the straight line from 0 to 1.
#define BEND(part, a, b, c, d) \
    ((part) * (1 - (part)) / 2 * ((2 - 3 * (part)) * (b) - (1 - (part)) * (a) + (3 * (part) - 1) * (c) - (part) * (d)))

__kernel void displacement_pixels(
    const int rows, const int columns, const int node_rows, const int node_columns, const int count, const int parts,
    const int logarithms, MAP nodes, OUT pixels)
{
    const int pieces = (columns + TILE - 1) / TILE, line = get_global_id(0) / pieces;
    const int number = line / rows, row = line - number * rows;
    if (number >= count) return;
    const int first = (get_global_id(0) - line * pieces) * TILE, end = min(first + TILE, columns);
    // Positions before the first node and after the last one have its value.
    const int before = LIMITED(NODE_OF(row), 0, GREATER(node_rows - 2, 0));
    const float y = LIMITED(ROW_PART(row, before), 0, LESSER(node_rows - 1, 1));
    const int inner = before > 0 && before < node_rows - 2, most = GREATER(node_columns - 2, 0);
    const int here = before * node_columns, low = LESSER(before + 1, node_rows - 1) * node_columns;
    const int up = GREATER(before - 1, 0) * node_columns, lowest = LESSER(before + 2, node_rows - 1) * node_columns;
    for (int base = first; base < end; base += STRIP) {
        const int limit = min(base + STRIP, end), node = NODE_OF(base), last = NODE_OF(limit - 1);
        const int from = LIMITED(node, 0, most) - 1, to = LIMITED(last, 0, most) + 2;
        OUT out = pixels + ((size_t)line * columns + base) * parts;
        float values[2][STRIP];
        for (int k = 0; k < parts; ++k) {
            MAP at = nodes + (size_t)(number * parts + k) * node_rows * node_columns;
            float cubic[SPAN + 2], linear[SPAN + 2];  // at the row, of each column of nodes
            for (int n = from; n <= to; ++n) {
                const int i = LIMITED(n, 0, node_columns - 1);
                const float straight = (1 - y) * at[here + i] + y * at[low + i];
                const float bend = BEND(y, at[up + i], at[here + i], at[low + i], at[lowest + i]);
                linear[n - from] = straight;
                cubic[n - from] = straight + (inner ? bend : 0 * bend);
            }
            float *restrict written = values[k & 1];
            for (int n = node; n <= last; ++n) {
                const int west = LIMITED(n, 0, most) - from;
                const float a = cubic[west - 1], d = cubic[west + 2];
                float b = cubic[west], c = cubic[west + 1];
                const float all = a + b + c + d;
                const int finite = all - all == 0;
                if (finite && n > 0 && n < most)
                    BETWEEN_NODES(n, base, limit, written[i - base] = (1 - part) * b + part * c + BEND(part, a, b, c, d);)
                else {
                    b = finite ? b : linear[west];
                    c = finite ? c : linear[west + 1];
                    const float from_west = n > most ? c + 0 * b : b, from_east = n < 0 ? b + 0 * c : c;
                    BETWEEN_NODES(n, base, limit, written[i - base] = (1 - part) * from_west + part * from_east;)
                }
            }
            if (logarithms)
                for (int i = 0; i < limit - base; ++i) written[i] = exponential(written[i]);
            if (parts != 2)
                for (int i = 0; i < limit - base; ++i) out[i * parts + k] = written[i];
        }
        if (parts == 2)
            for (int i = 0; i < limit - base; ++i) {
                out[2 * i] = values[0][i];
                out[2 * i + 1] = values[1][i];
            }
    }
}

// Position from the centre of a window, in halves of it.
#define PLACE(i) ((2 * (i) - (WINDOW - 1)) * (1.0f / WINDOW))

// Sums over columns of windows are kept for all columns of a work-item, or for one at a time if it has one node. Those
// of adjacent nodes are adjacent.
#if NODES > 1
#define WIDTH (((NODES - 1) * STEP + WINDOW + LANES - 1) / LANES * LANES)
#define SLOTS ((WIDTH - 1) / STEP + 1)
typedef float Column[STEP][SLOTS];
#define COLUMNS_OF_NODE(base) for (int k = 0; k < WINDOW; ++k)
#define KEEP(sums, column, values) \
    for (int lane = 0; lane < LANES; ++lane) sums[((column) + lane) % STEP][((column) + lane) / STEP] = LANE(values, lane);
#define OF_NODES(sums, node, k) KEPT(&sums[(k) % STEP][(k) / STEP + (node)])
#else
#define WIDTH 1
typedef float Column;
#define COLUMNS_OF_NODE(base) for (int k = base; k <= base; ++k)
#define KEEP(sums, column, values) sums = values;
#define OF_NODES(sums, node, k) sums
#endif

#define GROUPS (NODES / LANES)  // of nodes of a work-item, which are processed together

__kernel void displacement_solve(
    const int rows, const int columns, const int node_rows, const int node_columns, const int halo, MAP planes,
    MAP difference, MAP field, MAP inverse, OUT answer)
{
    const int pieces = (node_columns + NODES - 1) / NODES, item = get_global_id(0), node_row = item / pieces;
    if (node_row >= node_rows) return;
    const int node = (item - node_row * pieces) * NODES, last = min(node + NODES, node_columns) - 1;
    const int width = columns + 2 * halo, plane = width * (rows + 2 * halo), nodes = node_rows * node_columns;
    const int corner = (halo + FIRST + node_row * STEP) * width + halo + FIRST + node * STEP;

    // Solved for is the deviation from a field that is linear along the row.
    MAP along = field + node_row * node_columns;
    const float right = along[node], down = along[nodes + node], pixels = GREATER(last - node, 1) * STEP;
    const float right_slope = (along[last] - right) / pixels, down_slope = (along[nodes + last] - down) / pixels;

    F sums[GROUPS][PARAMETERS + 2];
    for (int g = 0; g < GROUPS; ++g)
        for (int k = 0; k < PARAMETERS + 2; ++k) sums[g][k] = 0;
    const int extent = (last - node) * STEP + WINDOW;
    for (int base = 0; base < extent; base += WIDTH) {
        Column of_x, of_y, of_x_down, of_y_down, of_level, of_level_down, of_gain, of_square, of_variance;
        for (int column = base; column < min(base + WIDTH, extent); column += LANES) {
            const F place = CONVERT(column + NUMBERS, F) - (WINDOW - 1) / 2.0f;
            const F to_right = right + right_slope * place, to_down = down + down_slope * place;
            F x = 0, y = 0, x_down = 0, y_down = 0, level = 0, level_down = 0, gain = 0, square = 0, variance = 0;
            for (int j = 0; j < WINDOW; ++j) {
                MAP at = planes + corner + j * width + column;
                MAP differs = difference + corner + j * width + column;
                const float below = PLACE(j);
                const F along_x = LOAD(at + plane), along_y = LOAD(at + 2 * plane);
                const F residual = LOAD(differs) - along_x * to_right - along_y * to_down;
                const F x_part = along_x * residual, y_part = along_y * residual;
                x += x_part;
                y += y_part;
                x_down += x_part * below;
                y_down += y_part * below;
                level += residual;
                level_down += residual * below;
                gain += LOAD(at + 3 * plane) * residual;
                square += residual * residual;
                variance += LOAD(differs + plane);
            }
            KEEP(of_x, column, x)
            KEEP(of_y, column, y)
            KEEP(of_x_down, column, x_down)
            KEEP(of_y_down, column, y_down)
            KEEP(of_level, column, level)
            KEEP(of_level_down, column, level_down)
            KEEP(of_gain, column, gain)
            KEEP(of_square, column, square)
            KEEP(of_variance, column, variance)
        }
        for (int g = 0; g < GROUPS; ++g) {
            F s0 = sums[g][0], s1 = sums[g][1], s2 = sums[g][2], s3 = sums[g][3], s4 = sums[g][4], s5 = sums[g][5];
            F s6 = sums[g][6], s7 = sums[g][7], s8 = sums[g][8], s9 = sums[g][9], s10 = sums[g][10], s11 = sums[g][11];
            COLUMNS_OF_NODE(base) {
                const float across = PLACE(k);
                const F x = OF_NODES(of_x, g * LANES, k), y = OF_NODES(of_y, g * LANES, k);
                const F level = OF_NODES(of_level, g * LANES, k);
                s0 += x;
                s1 += y;
                s2 += x * across;
                s3 += OF_NODES(of_x_down, g * LANES, k);
                s4 += y * across;
                s5 += OF_NODES(of_y_down, g * LANES, k);
                s6 += level;
                s7 += level * across;
                s8 += OF_NODES(of_level_down, g * LANES, k);
                s9 += OF_NODES(of_gain, g * LANES, k);
                s10 += OF_NODES(of_square, g * LANES, k);
                s11 += OF_NODES(of_variance, g * LANES, k);
            }
            const F all[] = {s0, s1, s2, s3, s4, s5, s6, s7, s8, s9, s10, s11};
            for (int k = 0; k < PARAMETERS + 2; ++k) sums[g][k] = all[k];
        }
    }

    for (int g = 0; g < GROUPS; ++g) {
        const int first = node + g * LANES, count = min(LANES, last + 1 - first);
        MAP packed = inverse + ((size_t)item * PACKED * GROUPS + g) * LANES;
        const F place = CONVERT(g * LANES + NUMBERS, F) * STEP;
        F solved[PARAMETERS], squares = sums[g][PARAMETERS];
        for (int k = 0; k < PARAMETERS; ++k) solved[k] = 0;
        for (int k = 0; k < PARAMETERS; ++k)
            for (int l = 0; l <= k; ++l) {
                const F element = LOAD(packed);
                packed += NODES;
                solved[k] += element * sums[g][l];
                if (l < k) solved[l] += element * sums[g][k];
            }
        for (int k = 0; k < PARAMETERS; ++k) squares -= solved[k] * sums[g][k];
        solved[0] += right + right_slope * place;
        solved[1] += down + down_slope * place;
        solved[2] += right_slope * (WINDOW / 2.0f);
        solved[4] += down_slope * (WINDOW / 2.0f);
        solved[AFFINE] = 1 - solved[PARAMETERS - 1];
        solved[AFFINE + 1] = squares;
        solved[AFFINE + 2] = sums[g][PARAMETERS + 1];
        OUT out = answer + node_row * node_columns + first;
        for (int k = 0; k < AFFINE + 3; ++k)
            for (int i = 0; i < count; ++i) out[k * nodes + i] = LANE(solved[k], i);
    }
}

// The same least squares without neighbours, for windows that hardly overlap: an item follows a window through all
// iterations, and its frame is interpolated in registers only.
#define MAGNITUDE(x) GREATER(x, -(x))
#define COLUMN_GROUPS ((WINDOW + LANES - 1) / LANES)
#define BENT 0.1f  // pixels per half window
#define MOST_SLOPE 3.0f

// Adds products with the differences of a row of the reference from values of the frame.
#define ADD_SAMPLES(within, values)                                                                          \
    {                                                                                                        \
        MAP at = corner + j * width + g * LANES;                                                             \
        const float below = PLACE(j);                                                                        \
        const F counts = LOAD(at), texture = LOAD(at + 3 * plane);                                           \
        const F differs = ((within) & (counts - counts == 0)) ? counts - (values) : 0;                       \
        const F by_x = differs * LOAD(at + plane), by_y = differs * LOAD(at + 2 * plane);                    \
        of_x += by_x;                                                                                        \
        of_y += by_y;                                                                                        \
        of_x_down += by_x * below;                                                                           \
        of_y_down += by_y * below;                                                                           \
        of_level += differs;                                                                                 \
        of_level_down += differs * below;                                                                    \
        of_gain += differs * texture;                                                                        \
        of_square += differs * differs;                                                                      \
    }

__kernel void displacement_follow(
    const int rows, const int columns, const int node_rows, const int node_columns, const int halo, const int top,
    const int bottom, const int left, const int right, const int iterations, const float settled, MAP coefficients,
    MAP planes, MAP inverse, MAP summary, MAP field, OUT answer)
{
    const int item = get_global_id(0), wide = right - left, nodes = node_rows * node_columns;
    if (item >= wide * (bottom - top)) return;
    const int node_row = top + item / wide, node_column = left + item % wide;
    const int node = node_row * node_columns + node_column;
    const int width = columns + 2 * halo, plane = width * (rows + 2 * halo), stride = columns + 2 * MARGIN;
    const int first_row = FIRST + node_row * STEP, first_column = FIRST + node_column * STEP;
    const int pieces = (node_columns + NODES - 1) / NODES, piece = node_column / NODES;
    MAP corner = planes + (halo + first_row) * width + halo + first_column;
    MAP packed = inverse + (size_t)(node_row * pieces + piece) * PACKED * NODES + node_column - piece * NODES;
    float moved[AFFINE], solved[PARAMETERS], squares = 0, change = NAN;
    for (int k = 0; k < AFFINE; ++k) moved[k] = field[k * nodes + node];
    for (int iteration = 0; iteration < iterations; ++iteration) {
        // The least squares represent small derivatives, so that all pixels are displaced alike.
        float largest = 0;
        for (int k = 2; k < AFFINE; ++k) largest = GREATER(largest, MAGNITUDE(moved[k]));
        const int bends = largest > BENT;
        for (int k = 2; k < AFFINE; ++k) moved[k] = bends ? moved[k] : 0;
        const float before = first_column + moved[0], above = first_row + moved[1];
        const int whole = before >= 0 && before + WINDOW <= columns && above >= 0 && above + WINDOW <= rows;
        F all_x = 0, all_y = 0, all_level = 0, x_across = 0, y_across = 0, level_across = 0;
        F of_x_down = 0, of_y_down = 0, of_level_down = 0, of_gain = 0, of_square = 0;
        for (int g = 0; g < COLUMN_GROUPS; ++g) {
            const I number = g * LANES + NUMBERS;
            const F across = PLACE(CONVERT(number, F));
            const I within = number < WINDOW;
            F of_x = 0, of_y = 0, of_level = 0;
            if (!bends && whole) {
                const int west = (int)before, north = (int)above;
                const float part_x = before - west, part_y = above - north;
                F x0, x1, x2, x3, y0, y1, y2, y3;
                CUBIC(x, part_x)
                CUBIC(y, part_y)
                MAP from = coefficients + (north - 1 + MARGIN) * stride + west - 1 + MARGIN + g * LANES;
                F line0 = LINE(from, x), line1 = LINE(from + stride, x), line2 = LINE(from + 2 * stride, x);
                for (int j = 0; j < WINDOW; ++j) {
                    const F line3 = LINE(from + (j + 3) * stride, x);
                    ADD_SAMPLES(within, y0 * line0 + y1 * line1 + y2 * line2 + y3 * line3)
                    line0 = line1;
                    line1 = line2;
                    line2 = line3;
                }
            } else {
                const F begin_x = CONVERT(number, F) + before + moved[2] * across, begin_y = above + moved[4] * across;
                for (int j = 0; j < WINDOW; ++j) {
                    F x = begin_x + moved[3] * PLACE(j), y = begin_y + j + moved[5] * PLACE(j);
                    const I inside = (x >= 0) & (x <= columns - 1) & (y >= 0) & (y <= rows - 1);
                    x = inside ? x : 0;
                    y = inside ? y : 0;
                    const F value = interpolate(coefficients, stride, &x, &y);
                    ADD_SAMPLES(within, inside ? value : (F)NAN)
                }
            }
            all_x += of_x;
            all_y += of_y;
            all_level += of_level;
            x_across += of_x * across;
            y_across += of_y * across;
            level_across += of_level * across;
        }
        const F all[] = {
            all_x, all_y, x_across, of_x_down, y_across, of_y_down, all_level, level_across, of_level_down, of_gain, of_square};
        float sums[PARAMETERS + 1];
        for (int k = 0; k <= PARAMETERS; ++k) sums[k] = sum_over_lanes(all[k]);
        for (int k = 0; k < PARAMETERS; ++k) solved[k] = 0;
        MAP element = packed;
        for (int k = 0; k < PARAMETERS; ++k)
            for (int l = 0; l <= k; ++l) {
                solved[k] += *element * sums[l];
                if (l < k) solved[l] += *element * sums[k];
                element += NODES;
            }
        squares = sums[PARAMETERS];
        for (int k = 0; k < PARAMETERS; ++k) squares -= solved[k] * sums[k];
        change = GREATER(MAGNITUDE(solved[0]), MAGNITUDE(solved[1]));
        if (!(squares - squares == 0 && change - change == 0)) {
            moved[0] = moved[1] = change = NAN;
            break;
        }
        for (int k = 0; k < 2; ++k) moved[k] += LIMITED(solved[k], -MOST_CHANGE, MOST_CHANGE);
        for (int k = 2; k < AFFINE; ++k) moved[k] = LIMITED(moved[k] + solved[k], -MOST_SLOPE, MOST_SLOPE);
        if (change < settled) break;
    }
    // The weights of a fraction and of one less it are the same, in reverse.
    const F noise = interpolated_noise(MAGNITUDE(moved[0] - (int)moved[0]), MAGNITUDE(moved[1] - (int)moved[1]));
    const float gain = 1 - solved[PARAMETERS - 1], samples = summary[3 * nodes + node];
    OUT out = answer + node;
    for (int k = 0; k < AFFINE; ++k) out[k * nodes] = moved[k];
    out[AFFINE * nodes] = gain;
    // The reference's noise is multiplied by the gain. By rounding, the squares may be below 0.
    out[(AFFINE + 1) * nodes] = (squares < 0 ? 0 : squares) / ((LANE(noise, 0) + gain * gain) * (samples - PARAMETERS));
    out[(AFFINE + 2) * nodes] = change;
}

// Within rounding.
F exact_inverse_roots(const F x)
{
    const F y = inverse_roots(x);
    return y * (1.5f - 0.5f * x * y * y);
}

// Inverts matrices, given by their lower triangles, in place, after scaling their diagonals to 1 (Cholesky).
// Returns for which of them this is possible within rounding.
I invert(F normal[PARAMETERS][PARAMETERS])
{
    F scale[PARAMETERS];
    I usable = (I)0 == 0;
    for (int k = 0; k < PARAMETERS; ++k) {
        const F square = normal[k][k];
        usable &= (square > 0) & (square < INFINITY);
        scale[k] = exact_inverse_roots(square);
    }
    // The triangle L of A = L L', with the inverse of its diagonal.
    for (int k = 0; k < PARAMETERS; ++k) {
        for (int l = 0; l <= k; ++l) {
            F sum = k == l ? (F)1 : normal[k][l] * scale[k] * scale[l];
            for (int m = 0; m < l; ++m) sum -= normal[k][m] * normal[l][m];
            if (k == l) usable &= sum > 0;
            normal[k][l] = k == l ? exact_inverse_roots(sum) : sum * normal[l][l];
        }
    }
    // Its inverse, by columns.
    for (int l = 0; l < PARAMETERS; ++l) {
        for (int k = l + 1; k < PARAMETERS; ++k) {
            F sum = 0;
            for (int m = l; m < k; ++m) sum -= normal[k][m] * normal[m][l];
            normal[k][l] = sum * normal[k][k];
        }
    }
    F squares = 0;
    for (int k = 0; k < PARAMETERS; ++k) {
        for (int l = 0; l <= k; ++l) {
            F sum = 0;
            for (int m = k; m < PARAMETERS; ++m) sum += normal[m][k] * normal[m][l];
            squares += (k == l ? 1 : 2) * sum * sum;
            normal[l][k] = sum;  // above the diagonal; later sums do not need it on the diagonal
        }
    }
    for (int k = 0; k < PARAMETERS; ++k)
        for (int l = 0; l <= k; ++l) normal[k][l] = normal[l][k] * scale[k] * scale[l];
    return usable & (squares < MOST * MOST);
}

// A column of the design matrix is a derivative of the reference, its texture or a constant, the factor, times powers of
// the distances from the centre. The moments of a product of two factors are its sums times products of such powers.
enum { XX, XY, YY, X, Y, DEFINED, X_TEXTURE, Y_TEXTURE, TEXTURE, SQUARE, FACTORS };
enum { ONE, BELOW, BELOW_2, ACROSS, BOTH, ACROSS_2, MOMENTS };

#define ADD_PRODUCTS(first, second, third, f)                                                                \
    {                                                                                                        \
        F a = 0, b = 0, c = 0, a_below = 0, b_below = 0, c_below = 0, a_below_2 = 0, b_below_2 = 0, c_below_2 = 0; \
        for (int j = 0; j < WINDOW; ++j) {                                                                   \
            MAP at = corner + j * width + column;                                                            \
            const F along_x = LOAD(at + plane), along_y = LOAD(at + 2 * plane), texture = LOAD(at + 3 * plane); \
            const F counts = LOAD(at), defined = counts - counts == 0 ? (F)1 : (F)0;                         \
            const F one = first, two = second, three = third;                                                \
            const float below = PLACE(j), below_2 = below * below;                                           \
            a += one;                                                                                        \
            b += two;                                                                                        \
            c += three;                                                                                      \
            a_below += one * below;                                                                          \
            b_below += two * below;                                                                          \
            c_below += three * below;                                                                        \
            a_below_2 += one * below_2;                                                                      \
            b_below_2 += two * below_2;                                                                      \
            c_below_2 += three * below_2;                                                                    \
        }                                                                                                    \
        const F all[3][3] = {{a, a_below, a_below_2}, {b, b_below, b_below_2}, {c, c_below, c_below_2}};     \
        for (int n = 0; n < 3; ++n)                                                                          \
            for (int m = 0; m < 3; ++m) KEEP(kept[(f) + n][m], column, all[n][m])                            \
    }

__kernel void displacement_normals(
    const int rows, const int columns, const int node_rows, const int node_columns, const int halo, MAP planes, OUT inverse,
    OUT summary)
{
    const int pieces = (node_columns + NODES - 1) / NODES, item = get_global_id(0), node_row = item / pieces;
    if (node_row >= node_rows) return;
    const int node = (item - node_row * pieces) * NODES, last = min(node + NODES, node_columns) - 1;
    const int width = columns + 2 * halo, plane = width * (rows + 2 * halo), nodes = node_rows * node_columns;
    MAP corner = planes + (halo + FIRST + node_row * STEP) * width + halo + FIRST + node * STEP;
    F sums[GROUPS][FACTORS][MOMENTS];
    for (int g = 0; g < GROUPS; ++g)
        for (int f = 0; f < FACTORS; ++f)
            for (int k = 0; k < MOMENTS; ++k) sums[g][f][k] = 0;
    const int extent = (last - node) * STEP + WINDOW;
    for (int base = 0; base < extent; base += WIDTH) {
        Column kept[FACTORS][3];
        for (int column = base; column < min(base + WIDTH, extent); column += LANES) {
            // A part of the products at a time, for their sums to stay in registers.
            ADD_PRODUCTS(along_x * along_x, along_x * along_y, along_y * along_y, XX)
            ADD_PRODUCTS(along_x, along_y, defined, X)
            ADD_PRODUCTS(along_x * texture, along_y * texture, texture, X_TEXTURE)
            F square = 0;
            for (int j = 0; j < WINDOW; ++j) {
                const F texture = LOAD(corner + 3 * plane + j * width + column);
                square += texture * texture;
            }
            KEEP(kept[SQUARE][0], column, square)
        }
        for (int g = 0; g < GROUPS; ++g)
            for (int f = 0; f < FACTORS; ++f) {
                F one = sums[g][f][ONE], below = sums[g][f][BELOW], below_2 = sums[g][f][BELOW_2];
                F across = sums[g][f][ACROSS], both = sums[g][f][BOTH], across_2 = sums[g][f][ACROSS_2];
                COLUMNS_OF_NODE(base) {
                    const float place = PLACE(k);
                    const F value = OF_NODES(kept[f][0], g * LANES, k);
                    one += value;
                    if (f == SQUARE) continue;
                    const F moment = OF_NODES(kept[f][1], g * LANES, k);
                    across += value * place;
                    below += moment;
                    if (f >= X_TEXTURE) continue;
                    across_2 += value * place * place;
                    both += moment * place;
                    below_2 += OF_NODES(kept[f][2], g * LANES, k);
                }
                const F all[] = {one, below, below_2, across, both, across_2};
                for (int k = 0; k < MOMENTS; ++k) sums[g][f][k] = all[k];
            }
    }
    for (int g = 0; g < GROUPS; ++g) {
        // Of the columns of the design matrix: the factor, and the moment of its product with one that has no powers.
        const int factor[PARAMETERS] = {0, 1, 0, 0, 1, 1, 2, 2, 2, 3};
        const int power[PARAMETERS] = {ONE, ONE, ACROSS, BELOW, ACROSS, BELOW, ONE, ACROSS, BELOW, ONE};
        const int product[4][4] = {{XX, XY, X, X_TEXTURE}, {XY, YY, Y, Y_TEXTURE}, {X, Y, DEFINED, TEXTURE}, {X_TEXTURE, Y_TEXTURE, TEXTURE, SQUARE}};
        F normal[PARAMETERS][PARAMETERS];
        for (int k = 0; k < PARAMETERS; ++k)
            for (int l = 0; l <= k; ++l) {
                const int p = power[k], q = power[l];
                const int moment = p == ONE ? q : q == ONE ? p : p != q ? BOTH : p == ACROSS ? ACROSS_2 : BELOW_2;
                normal[k][l] = sums[g][product[factor[k]][factor[l]]][moment];
            }
        const F samples = normal[AFFINE][AFFINE];
        const I usable = invert(normal);
        OUT packed = inverse + ((size_t)item * PACKED * GROUPS + g) * LANES;
        for (int k = 0; k < PARAMETERS; ++k)
            for (int l = 0; l <= k; ++l) {
                normal[k][l] = usable ? normal[k][l] : (F)NAN;
                STORE(packed, normal[k][l]);
                packed += NODES;
            }
        const int first = node + g * LANES, count = min(LANES, last + 1 - first);
        const F some[] = {normal[0][0], normal[1][0], normal[1][1], samples};
        for (int k = 0; k < 4; ++k)
            for (int i = 0; i < count; ++i) summary[k * nodes + node_row * node_columns + first + i] = LANE(some[k], i);
    }
}

#define REACH 2  // nodes on either side whose windows predict the displacement of a node

__kernel void displacement_field(
    const int node_rows, const int node_columns, const float hold, MAP trust, MAP answer, MAP field, OUT next_field)
{
    const int pieces = (node_columns + TILE - 1) / TILE, row = get_global_id(0) / pieces, nodes = node_rows * node_columns;
    if (row >= node_rows) return;
    const int first = (get_global_id(0) - row * pieces) * TILE, end = min(first + TILE, node_columns);
    const float binomial[2 * REACH + 1] = {1.0f / 16, 4.0f / 16, 6.0f / 16, 4.0f / 16, 1.0f / 16};
    for (int node = first; node < end; node += STRIP) {
        const int size = min(STRIP, end - node), here = row * node_columns + node;
        float total[STRIP], right[STRIP], down[STRIP];
        for (int i = 0; i < size; ++i) total[i] = hold;
        for (int i = 0; i < size; ++i) right[i] = hold * field[here + i];
        for (int i = 0; i < size; ++i) down[i] = hold * field[nodes + here + i];
        for (int j = GREATER(-REACH, -row); j <= LESSER(REACH, node_rows - 1 - row); ++j)
            for (int k = -REACH; k <= REACH; ++k) {
                const float share = binomial[j + REACH] * binomial[k + REACH];
                const float below = -j * (2.0f * STEP / WINDOW), across = -k * (2.0f * STEP / WINDOW);
                const int low = GREATER(0, -node - k), high = LESSER(size, node_columns - node - k);
                const int other = here + j * node_columns + k;
                for (int i = low; i < high; ++i) {
                    MAP at = answer + other + i;
                    const float to_right = at[0], to_down = at[nodes], trusted = trust[other + i];
                    const float right_x = at[2 * nodes], right_y = at[3 * nodes];
                    const float down_x = at[4 * nodes], down_y = at[5 * nodes];
                    const float from_right = field[other + i], from_down = field[nodes + other + i];
                    const float weight = to_right - to_right == 0 ? share * trusted : 0;
                    const float new_right = from_right + LIMITED(to_right - from_right, -MOST_CHANGE, MOST_CHANGE)
                        + LIMITED(right_x, -1, 1) * across + LIMITED(right_y, -1, 1) * below;
                    const float new_down = from_down + LIMITED(to_down - from_down, -MOST_CHANGE, MOST_CHANGE)
                        + LIMITED(down_x, -1, 1) * across + LIMITED(down_y, -1, 1) * below;
                    // NaN is limited to a number, which has no weight.
                    total[i] += weight;
                    right[i] += weight * new_right;
                    down[i] += weight * new_down;
                }
            }
        for (int i = 0; i < size; ++i) next_field[here + i] = right[i] / total[i];
        for (int i = 0; i < size; ++i) next_field[nodes + here + i] = down[i] / total[i];
    }
}
