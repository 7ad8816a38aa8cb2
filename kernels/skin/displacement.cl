// Displacement of a texture: spline of a frame, interpolation of the displaced frame, and least squares in windows.
// Specification: displacement.py.
//
// FRAME   type of a sample
// TILE    pixels of one work-item: 1 on a GPU, many on a CPU
// WINDOW  pixels of a window's side
// TOP     value of a saturated sample; undefined for floats
//
// The sums of a window are kept for each of its columns, and added at the end: on a CPU the columns of a chunk are
// the lanes of a vector, and the order of additions does not change.

#pragma OPENCL FP_CONTRACT OFF

#include "common.clh"

#define TAPS 8
#define MARGIN (TAPS + 4)
#define PARAMETERS 10
#define AFFINE 6  // number of affine parameters
#define MOST 1e5f  // maximum magnitude of an inverse matrix

__kernel void displacement_pad(const int rows, const int columns, __global const FRAME *restrict frame, OUT padded)
{
    const int width = columns + 2 * MARGIN, pixels = width * (rows + 2 * MARGIN);
    const int first = get_global_id(0) * TILE, end = min(first + TILE, pixels);
    for (int p = first; p < end; ++p) {
        int row = abs(p / width - MARGIN), column = abs(p % width - MARGIN);
        row = row < rows ? row : 2 * (rows - 1) - row;
        column = column < columns ? column : 2 * (columns - 1) - column;
        padded[p] = frame[row * columns + column];
    }
}

// sqrt(3) times the powers of the spline's pole, sqrt(3) - 2.
#define BESIDE(k, weight) (weight) * (source[p - (k) * step] + source[p + (k) * step])

__kernel void displacement_filter(const int pixels, const int step, MAP source, OUT filtered)
{
    const int first = get_global_id(0) * TILE, reach = TAPS * step;
    const int begin = max(first, reach), end = min(first + TILE, pixels - reach);
    for (int p = begin; p < end; ++p) {
        filtered[p] = 1.7320508f * source[p] + BESIDE(1, -0.46410162f) + BESIDE(2, 0.12435565f)
            + BESIDE(3, -0.033320997f) + BESIDE(4, 0.0089283345f) + BESIDE(5, -0.0023923402f)
            + BESIDE(6, 6.4102660e-4f) + BESIDE(7, -1.7176256e-4f) + BESIDE(8, 4.6023640e-5f);
    }
}

#ifdef TOP
#define KNOWN(sample) ((sample) != TOP)
#else
#define KNOWN(sample) ((sample) - (sample) == 0)
#endif

// Positions beyond an end are mirrored.
#define MIRROR(place, length) \
    ((place) < 0 ? -(place) : (place) < (length) ? (place) : 2 * ((length) - 1) - (place))

#define FIRST_OF_MEAN (-(WINDOW / 2))

__kernel void displacement_across(
    const int rows, const int columns, __global const FRAME *restrict frame, OUT sums, OUT counts)
{
    const int pieces = (columns + TILE - 1) / TILE, row = get_global_id(0) / pieces;
    if (row >= rows) return;
    const int first = (get_global_id(0) - row * pieces) * TILE, end = min(first + TILE, columns);
    __global const FRAME *restrict samples = frame + row * columns;
    for (int column = first; column < end; ++column) {
        float sum = 0, count = 0;
        for (int k = FIRST_OF_MEAN; k < FIRST_OF_MEAN + WINDOW; ++k) {
            const FRAME sample = samples[MIRROR(column + k, columns)];
            const int defined = KNOWN(sample);
            sum += defined ? (float)sample : 0;
            count += defined;
        }
        sums[row * columns + column] = sum;
        counts[row * columns + column] = count;
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
    for (int x = first; x < end; ++x) {
        const int column = x - halo, p = y * width + x;
        float value = NAN, along_x = 0, along_y = 0, texture = 0;
        if (row >= 0 && row < rows && column >= 0 && column < columns) {
            const FRAME sample = frame[row * columns + column];
            if (KNOWN(sample)) {
                value = sample;
                MAP at = coefficients + (row + MARGIN) * stride + column + MARGIN;
                along_x = (BESIDES(at - stride) + 4 * BESIDES(at) + BESIDES(at + stride)) * (1.0f / 12);
                along_y = (ABOVES(at - 1) + 4 * ABOVES(at) + ABOVES(at + 1)) * (1.0f / 12);
                float sum = 0, count = 0;
                for (int k = FIRST_OF_MEAN; k < FIRST_OF_MEAN + WINDOW; ++k) {
                    const int other = MIRROR(row + k, rows) * columns + column;
                    sum += sums[other];
                    count += counts[other];
                }
                texture = value - sum / count;
            }
        }
        planes[p] = value;
        planes[plane + p] = along_x;
        planes[2 * plane + p] = along_y;
        planes[3 * plane + p] = texture;
        difference[p] = difference[plane + p] = 0;
    }
}

// Weights of the coefficients at -1, 0, 1 and 2, for a position from 0 to 1.
#define CUBIC(w, part) { \
    const float rest = 1 - (part); \
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

#define LINE(at, w) (w##0 * (at)[0] + w##1 * (at)[1] + w##2 * (at)[2] + w##3 * (at)[3])

// The node before a pixel, and the fraction of the way to the next one.
#define SPLIT(pixel, nodes, node, part) \
    float part = ((pixel) - start) / step; \
    part = part > 0 ? part : 0; \
    part = part < (nodes) - 1 ? part : (nodes) - 1; \
    int node = (int)part; \
    node = node < (nodes) - 2 ? node : (nodes) - 2; \
    node = node > 0 ? node : 0; \
    part -= node;

// Weights of the nodes at -1, 0, 1 and 2: Keys' cubic, linear in the last interval at each end.
#define KEYS(node, part, nodes) \
    const float bend_##node = node > 0 && node < (nodes) - 2 ? (part) * (1 - (part)) / 2 : 0; \
    const float node##0 = -bend_##node * (1 - (part)), node##3 = -bend_##node * (part); \
    const float node##1 = 1 - (part) + bend_##node * (2 - 3 * (part)); \
    const float node##2 = (part) + bend_##node * (3 * (part) - 1);

__kernel void displacement_warp(
    const int rows, const int columns, const int node_rows, const int node_columns, const int step, const float start,
    const int halo, MAP coefficients, MAP planes, MAP field, OUT difference)
{
    const int pieces = (columns + TILE - 1) / TILE, row = get_global_id(0) / pieces;
    if (row >= rows) return;
    const int first = (get_global_id(0) - row * pieces) * TILE, end = min(first + TILE, columns);
    const int width = columns + 2 * halo, plane = width * (rows + 2 * halo), stride = columns + 2 * MARGIN;
    const int nodes = node_rows * node_columns;
    SPLIT(row, node_rows, node_row, part_row)
    MAP upper = field + node_row * node_columns;
    MAP lower = upper + (node_rows > 1 ? node_columns : 0);
    for (int column = first; column < end; ++column) {
        SPLIT(column, node_columns, node, part)
        const int next = node + (node_columns > 1);
        const float right = (1 - part) * ((1 - part_row) * upper[node] + part_row * lower[node])
            + part * ((1 - part_row) * upper[next] + part_row * lower[next]);
        const float down = (1 - part) * ((1 - part_row) * upper[nodes + node] + part_row * lower[nodes + node])
            + part * ((1 - part_row) * upper[nodes + next] + part_row * lower[nodes + next]);
        float x = column + right, y = row + down;
        const int inside = (x >= 0) & (x <= columns - 1) & (y >= 0) & (y <= rows - 1);
        x = inside ? x : 0;
        y = inside ? y : 0;
        const int west = (int)x, north = (int)y;
        x -= west;
        y -= north;
        float x0, x1, x2, x3, y0, y1, y2, y3;
        CUBIC(x, x)
        CUBIC(y, y)
        MAP at = coefficients + (north - 1 + MARGIN) * stride + west - 1 + MARGIN;
        const float value = y0 * LINE(at, x) + y1 * LINE(at + stride, x) + y2 * LINE(at + 2 * stride, x)
            + y3 * LINE(at + 3 * stride, x);
        const int p = (row + halo) * width + column + halo;
        const float counts = planes[p];
        const int measured = counts - counts == 0;
        const float deviation = counts - value + planes[plane + p] * right + planes[2 * plane + p] * down;
        difference[p] = measured ? (inside ? deviation : NAN) : 0;
        difference[plane + p] = measured ? 1 + NOISE_GAIN(x) * NOISE_GAIN(y) : 0;
    }
}

__kernel void displacement_pixels(
    const int rows, const int columns, const int node_rows, const int node_columns, const int step, const float start,
    const int count, const int parts, const int logarithms, MAP nodes, OUT pixels)
{
    const int pieces = (columns + TILE - 1) / TILE, line = get_global_id(0) / pieces;
    const int number = line / rows, row = line - number * rows;
    if (number >= count) return;
    const int first = (get_global_id(0) - line * pieces) * TILE, end = min(first + TILE, columns);
    OUT out = pixels + (size_t)line * columns * parts;
    SPLIT(row, node_rows, y, part_y)
    KEYS(y, part_y, node_rows)
    const int up = GREATER(y - 1, 0) * node_columns, low = LESSER(y + 1, node_rows - 1) * node_columns;
    const int lowest = LESSER(y + 2, node_rows - 1) * node_columns, here = y * node_columns;
    SPLIT(first, node_columns, west, part_west)
    SPLIT(end - 1, node_columns, east, part_east)
    const int begin = GREATER(west - 1, 0), last = LESSER(east + 2, node_columns - 1);
    for (int k = 0; k < parts; ++k) {
        MAP at = nodes + (number * parts + k) * node_rows * node_columns;
        float cubic[TILE + 4], linear[TILE + 4];  // at the row, of each column of nodes
        for (int i = begin; i <= last; ++i) {
            cubic[i - begin] = y0 * at[up + i] + y1 * at[here + i] + y2 * at[low + i] + y3 * at[lowest + i];
            linear[i - begin] = (1 - part_y) * at[here + i] + part_y * at[low + i];
        }
        for (int column = first; column < end; ++column) {
            SPLIT(column, node_columns, x, part)
            KEYS(x, part, node_columns)
            const int previous = GREATER(x - 1, 0) - begin, next = LESSER(x + 1, node_columns - 1) - begin;
            const int farthest = LESSER(x + 2, node_columns - 1) - begin, nearest = x - begin;
            const float value = x0 * cubic[previous] + x1 * cubic[nearest] + x2 * cubic[next] + x3 * cubic[farthest];
            const float plain = (1 - part) * linear[nearest] + part * linear[next];
            const float chosen = value - value == 0 ? value : plain;
            out[column * parts + k] = logarithms ? exponential(chosen) : chosen;
        }
    }
}

#define LANES (TILE > 1 ? 8 : 1)  // columns of a window processed together

#define PLACE(i) ((2 * (i) - (WINDOW - 1)) * (1.0f / WINDOW))

#define CLEAR(sum) for (int i = 0; i < LANES; ++i) sum[i] = 0;

__kernel void displacement_solve(
    const int rows, const int columns, const int node_rows, const int node_columns, const int step, const int first,
    const int halo, MAP planes, MAP difference, MAP field, MAP inverse, OUT answer)
{
    const int nodes = node_rows * node_columns, node = get_global_id(0);
    if (node >= nodes) return;
    const int width = columns + 2 * halo, plane = width * (rows + 2 * halo);
    const int corner = (first + node / node_columns * step) * width + first + node % node_columns * step;
    const float right = field[node], down = field[nodes + node];

    float sums[PARAMETERS] = {0}, squares = 0, variances = 0;
    for (int chunk = 0; chunk < WINDOW; chunk += LANES) {
        float x[LANES], y[LANES], x_down[LANES], y_down[LANES], level[LANES], level_down[LANES], gain[LANES];
        float square[LANES], variance[LANES];
        CLEAR(x) CLEAR(y) CLEAR(x_down) CLEAR(y_down) CLEAR(level) CLEAR(level_down) CLEAR(gain) CLEAR(square)
        CLEAR(variance)
        for (int j = 0; j < WINDOW; ++j) {
            MAP at = planes + corner + j * width + chunk;
            MAP differs = difference + corner + j * width + chunk;
            const float below = PLACE(j);
            for (int i = 0; i < LANES; ++i) {
                const float along_x = at[plane + i], along_y = at[2 * plane + i];
                const float residual = differs[i] - along_x * right - along_y * down;
                x[i] += along_x * residual;
                y[i] += along_y * residual;
                x_down[i] += along_x * residual * below;
                y_down[i] += along_y * residual * below;
                level[i] += residual;
                level_down[i] += residual * below;
                gain[i] += at[3 * plane + i] * residual;
                square[i] += residual * residual;
                variance[i] += differs[plane + i];
            }
        }
        const int count = WINDOW - chunk < LANES ? WINDOW - chunk : LANES;
        for (int i = 0; i < count; ++i) {
            const float across = PLACE(chunk + i);
            sums[0] += x[i];
            sums[1] += y[i];
            sums[2] += x[i] * across;
            sums[3] += x_down[i];
            sums[4] += y[i] * across;
            sums[5] += y_down[i];
            sums[6] += level[i];
            sums[7] += level[i] * across;
            sums[8] += level_down[i];
            sums[9] += gain[i];
            squares += square[i];
            variances += variance[i];
        }
    }

    for (int k = 0; k < PARAMETERS; ++k) {
        float coefficient = 0;
        for (int l = 0; l < PARAMETERS; ++l) coefficient += inverse[(node * PARAMETERS + k) * PARAMETERS + l] * sums[l];
        squares -= coefficient * sums[k];
        if (k < AFFINE) answer[k * nodes + node] = coefficient + (k == 0 ? right : k == 1 ? down : 0);
        if (k == PARAMETERS - 1) answer[AFFINE * nodes + node] = 1 - coefficient;
    }
    answer[(AFFINE + 1) * nodes + node] = squares;
    answer[(AFFINE + 2) * nodes + node] = variances;
}

// Inverts a matrix, given by its lower triangle, in place, after scaling its diagonal to 1 (Cholesky).
// Returns whether this is possible within rounding.
int invert(float normal[PARAMETERS][PARAMETERS])
{
    float scale[PARAMETERS];
    for (int k = 0; k < PARAMETERS; ++k) {
        const float square = normal[k][k];
        if (!(square > 0 && square < INFINITY)) return 0;
        scale[k] = inverse_root(square);
    }
    // The triangle L of A = L L', with the inverse of its diagonal.
    for (int k = 0; k < PARAMETERS; ++k) {
        for (int l = 0; l <= k; ++l) {
            float sum = k == l ? 1 : normal[k][l] * scale[k] * scale[l];
            for (int m = 0; m < l; ++m) sum -= normal[k][m] * normal[l][m];
            if (k == l && !(sum > 0)) return 0;
            normal[k][l] = k == l ? inverse_root(sum) : sum * normal[l][l];
        }
    }
    // Its inverse, by columns.
    for (int l = 0; l < PARAMETERS; ++l) {
        for (int k = l + 1; k < PARAMETERS; ++k) {
            float sum = 0;
            for (int m = l; m < k; ++m) sum -= normal[k][m] * normal[m][l];
            normal[k][l] = sum * normal[k][k];
        }
    }
    float squares = 0;
    for (int k = 0; k < PARAMETERS; ++k) {
        for (int l = 0; l <= k; ++l) {
            float sum = 0;
            for (int m = k; m < PARAMETERS; ++m) sum += normal[m][k] * normal[m][l];
            squares += (k == l ? 1 : 2) * sum * sum;
            normal[l][k] = sum;  // above the diagonal; later sums do not need it on the diagonal
        }
    }
    for (int k = 0; k < PARAMETERS; ++k)
        for (int l = 0; l <= k; ++l) normal[k][l] = normal[l][k] = normal[l][k] * scale[k] * scale[l];
    return squares < MOST * MOST;
}

__kernel void displacement_normals(
    const int rows, const int columns, const int node_rows, const int node_columns, const int step, const int first,
    const int halo, MAP planes, OUT inverse, OUT summary)
{
    const int nodes = node_rows * node_columns, node = get_global_id(0);
    if (node >= nodes) return;
    const int width = columns + 2 * halo, plane = width * (rows + 2 * halo);
    MAP corner = planes + (first + node / node_columns * step) * width + first + node % node_columns * step;
    float normal[PARAMETERS][PARAMETERS];
    for (int k = 0; k < PARAMETERS; ++k)
        for (int l = 0; l < PARAMETERS; ++l) normal[k][l] = 0;
    for (int j = 0; j < WINDOW; ++j) {
        for (int i = 0; i < WINDOW; ++i) {
            MAP at = corner + j * width + i;
            const float x = at[plane], y = at[2 * plane], defined = at[0] - at[0] == 0;
            const float across = PLACE(i), below = PLACE(j);
            const float column[PARAMETERS] = {x, y, x * across, x * below, y * across, y * below, defined,
                defined * across, defined * below, at[3 * plane]};
            #pragma unroll
            for (int k = 0; k < PARAMETERS; ++k) {
                #pragma unroll
                for (int l = 0; l <= k; ++l) normal[k][l] += column[k] * column[l];
            }
        }
    }
    summary[3 * nodes + node] = normal[AFFINE][AFFINE];
    const int usable = invert(normal);
    for (int k = 0; k < PARAMETERS; ++k)
        for (int l = 0; l < PARAMETERS; ++l)
            inverse[(node * PARAMETERS + k) * PARAMETERS + l] = usable ? normal[k][l] : NAN;
    summary[node] = usable ? normal[0][0] : NAN;
    summary[nodes + node] = usable ? normal[1][0] : NAN;
    summary[2 * nodes + node] = usable ? normal[1][1] : NAN;
}
