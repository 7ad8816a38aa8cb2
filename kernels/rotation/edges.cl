// Edges: jumps of the normal, and the end of contact. Specification: edges.py.
//
// TILE      pixels of one work-item, at most CHUNK of them at a time; 1 on a GPU
// SPACING   distance between evaluated pixels, and side of a cell, pixels
// STEPS     number of distances of pairs from the pixel: 3, or 2 that must agree
// MIN_PAIRS minimum number of valid pairs
// REACH     half-width of the non-maximum suppression, pixels
// GUARD     minimum distance from the lines of earlier passes, pixels
// PART      minimum share of the mean difference that the jump must be
// FIRST     1 in the first pass, when there are no lines yet and all pixels are undecided
// LAST      1 in the last pass
//
// Cells are six planes (x, y, z, variance, share of valid pixels, 1 where no line is drawn), with a margin that contains
// all pairs. PoCL vectorises loops over pixels without calls, branches and inner loops.

#include "common.clh"

#define DIRECTIONS 8
#define MARGIN 10
#define LINES 3

#define CHUNK (TILE < 64 ? TILE : 64)

#define EACH_PIXEL                                                                               \
    const int begin = (int)get_global_id(0) * TILE, all = rows * columns;                        \
    for (int p = begin; p < LESSER(begin + TILE, all); ++p)

#define FINITE(value) ((value) - (value) == 0.0f)

// Runs of CHUNK pixels of a row, one per item.
#define RUN(columns)                                                                               \
    const int runs = ((columns) + CHUNK - 1) / CHUNK, line = (int)get_global_id(0) / runs;         \
    const int from = (int)get_global_id(0) % runs * CHUNK, width = LESSER(CHUNK, (columns) - from);

__kernel void edges_clean(
    const int rows, const int columns, __global const uchar *restrict contact, __global uchar *restrict clean)
{
    RUN(columns)
    if (line >= rows) return;
    const int first = from == 0, last = from + width == columns ? width + 1 : width + 2;  // within the row
    const int top = GREATER(line - 1, 0), bottom = LESSER(line + 1, rows - 1);
    int touched[CHUNK + 2];
    for (int i = 0; i < width + 2; ++i) touched[i] = 0;
    for (int y = top; y <= bottom; ++y) {
        __global const uchar *here = contact + y * columns + from - 1;
        for (int i = first; i < last; ++i) touched[i] += here[i] != 0;
    }
    __global const uchar *middle = contact + line * columns + from;
    for (int i = 0; i < width; ++i) {
        const int own = middle[i] != 0, near = touched[i] + touched[i + 1] + touched[i + 2] - own, x = from + i;
        const int neighbours = (bottom - top + 1) * (1 + (x > 0) + (x + 1 < columns)) - 1;
        const int stays = (near > 1) | (neighbours < 2), fills = (4 * near >= 3 * neighbours) & (neighbours > 0);
        clean[line * columns + x] = own ? stays : fills;
    }
}

// Cells include the margin.
__kernel void edges_cells(
    const int rows, const int columns, MAP vectors, MAP sigma, __global const uchar *restrict contact,
    __global const uchar *restrict clean, OUT cells)
{
    const int stride = columns + 2 * MARGIN, high = rows + 2 * MARGIN, plane = high * stride;
    RUN(stride)
    if (line >= high) return;
    const int row = line - MARGIN, target = line * stride + from;
    const int inside = row >= 0 && row < rows;
    const int begin = inside ? GREATER(MARGIN - from, 0) : width;
    const int end = inside ? LESSER(columns + MARGIN - from, width) : width;
    for (int k = 0; k < 6; ++k)
        for (int i = 0; i < width; ++i) cells[k * plane + target + i] = k == 5;
    for (int i = begin; i < end; ++i) {
        const int p = row * columns + from + i - MARGIN;
        const float x = vectors[3 * p], y = vectors[3 * p + 1], z = vectors[3 * p + 2], s = sigma[p];
        const int valid = (clean[p] != 0) & (contact[p] != 0) & (s >= 0) & (s < INFINITY) & FINITE(x) & FINITE(y) & FINITE(z);
        cells[target + i] = valid ? x : 0;
        cells[plane + target + i] = valid ? y : 0;
        cells[2 * plane + target + i] = valid ? z : 0;
        cells[3 * plane + target + i] = valid ? s * s : 0;
        cells[4 * plane + target + i] = valid;
    }
}

// Sums over columns of three rows, and then over three of these.
#define JOIN_ROW(map) (map[q - stride] + map[q] + map[q + stride])
#define JOIN_THREE(sums) (sums[i] + sums[i + 1] + sums[i + 2])
__kernel void edges_join(const int rows, const int columns, MAP cells, __global const uchar *restrict edges, OUT joined)
{
    const int stride = columns + 2 * MARGIN, high = rows + 2 * MARGIN, plane = high * stride;
    RUN(stride)
    if (line >= high) return;
    const int start = line * stride + from, row = line - MARGIN;
    __global const float *valid = cells + 4 * plane;
    float count[CHUNK + 2], sum[CHUNK + 2], free[CHUNK + 2];
    const int first = from == 0, last = from + width == stride ? width + 1 : width + 2;  // within the row
    for (int i = 0; i < width + 2; ++i) count[i] = sum[i] = 0, free[i] = 1;
    if (line == 0 || line == high - 1) {
        for (int k = 0; k < 6; ++k)
            for (int i = 0; i < width; ++i) joined[k * plane + start + i] = 0;
        return;
    }
    for (int i = first; i < last; ++i) {
        const int q = start + i - 1;
        count[i] = JOIN_ROW(valid);
    }
    for (int down = GREATER(row - 1, 0); down <= LESSER(row + 1, rows - 1); ++down) {
        const int begin = GREATER(MARGIN + 1 - from, 0), end = LESSER(columns + MARGIN + 1 - from, width + 2);
        __global const uchar *drawn = edges + down * columns + from - MARGIN - 1;
        for (int i = begin; i < end; ++i) free[i] = drawn[i] ? 0 : free[i];
    }
    for (int k = 0; k < 4; ++k) {
        __global const float *cell = cells + k * plane;
        for (int i = first; i < last; ++i) {
            const int q = start + i - 1;
            sum[i] = JOIN_ROW(cell);
        }
        for (int i = 0; i < width; ++i) {
            const float all = JOIN_THREE(count);
            joined[k * plane + start + i] = JOIN_THREE(sum) / GREATER(all, 1);
        }
    }
    for (int i = 0; i < width; ++i) {
        joined[4 * plane + start + i] = JOIN_THREE(count) / 9;
        joined[5 * plane + start + i] = free[i] * free[i + 1] * free[i + 2];
    }
    if (from == 0)
        for (int k = 0; k < 6; ++k) joined[k * plane + start] = 0;
    if (from + width == stride)
        for (int k = 0; k < 6; ++k) joined[k * plane + start + width - 1] = 0;
}

#ifdef SPACING
__kernel void edges_jumps(
    const int rows, const int columns, MAP cells, MAP pairs, const float jump, const float bend,
    const float significance, const float quiet, const float floor_, const float lowest,
    __global uchar *restrict undecided, OUT strength, __global uchar *restrict directions)
{
    const int runs = (columns + CHUNK - 1) / CHUNK, row = (int)get_global_id(0) / runs;
    const int first = (int)get_global_id(0) % runs * CHUNK;
    if (row >= rows) return;
    const int width = LESSER(CHUNK, columns - first), target = row * columns + first;
    int busy = 0;
    for (int i = 0; i < width; ++i) busy |= FIRST || undecided[target + i];
    if (!busy) {
        for (int i = 0; i < width; ++i) strength[target + i] = 0;
        return;
    }
    const int stride = columns + 2 * MARGIN, plane = (rows + 2 * MARGIN) * stride;
    __global const float *x = cells + (row + MARGIN) * stride + first + MARGIN, *y = x + plane, *z = y + plane;
    __global const float *variance = z + plane, *valid = variance + plane, *unbarred = valid + plane;
#if TILE > 1  // far from all contact there is no pair
    float around = 0;
    for (int away = 0; away <= MARGIN * stride && !(around > 0); away += stride)
        for (int i = -MARGIN; i < width + MARGIN; ++i) around += valid[i + away] + valid[i - away];
    if (!(around > 0)) {
        for (int i = 0; i < width; ++i) {
            undecided[target + i] = FIRST || undecided[target + i];
            strength[target + i] = directions[target + i] = 0;
        }
        return;
    }
#endif

    float best[CHUNK], square[CHUNK], error[CHUNK], min_variance[CHUNK];
    int direction[CHUNK];
    for (int i = 0; i < width; ++i) {
        best[i] = square[i] = error[i] = 0;
        min_variance[i] = 1e30f;
        direction[i] = 0;
    }
    for (int w = 0; w < DIRECTIONS; ++w) {
        float n[CHUNK], u1[CHUNK], u2[CHUNK], v[CHUNK];
        float x0[CHUNK], y0[CHUNK], z0[CHUNK], x1[CHUNK], y1[CHUNK], z1[CHUNK];
        for (int i = 0; i < width; ++i) n[i] = u1[i] = u2[i] = v[i] = x0[i] = y0[i] = z0[i] = x1[i] = y1[i] = z1[i] = 0;
        for (int line = 0; line < LINES; ++line) {
            float open[CHUNK];
            for (int i = 0; i < width; ++i) open[i] = 1;
            for (int step = 0; step < STEPS; ++step) {
                MAP pair = pairs + 3 * ((w * LINES + line) * STEPS + step);  // columns, rows, distance
                const int away = (int)pair[1] * stride + (int)pair[0];
                const float u = pair[2];
#if SPACING > 1
                if (step > 0) {
                    for (int i = 0; i < width; ++i) open[i] *= unbarred[i + away] * unbarred[i - away];
                }
#endif
                if (!(u > 0)) continue;
                for (int i = 0; i < width; ++i) {
                    const float both = valid[i + away] * valid[i - away] * open[i];
#if STEPS == 2
                    const float weight = step == 0 ? both : 0, moment = step == 0 ? 0 : both;
#else
                    const float weight = both, moment = both * u;
#endif
                    const float dx = x[i + away] - x[i - away], dy = y[i + away] - y[i - away];
                    const float dz = z[i + away] - z[i - away];
                    n[i] += weight;
                    u1[i] += moment;
                    u2[i] += moment * u;
                    v[i] += weight * (variance[i + away] + variance[i - away]);
                    x0[i] += weight * dx;
                    y0[i] += weight * dy;
                    z0[i] += weight * dz;
                    x1[i] += moment * dx;
                    y1[i] += moment * dy;
                    z1[i] += moment * dz;
                }
            }
        }
        for (int i = 0; i < width; ++i) {
            int usable = n[i] >= MIN_PAIRS;
            const float per_n = 1 / GREATER(n[i], 0.1f);
            const float mean = (x0[i] * x0[i] + y0[i] * y0[i] + z0[i] * z0[i]) * per_n * per_n;
#if STEPS == 2
            usable &= u1[i] >= MIN_PAIRS;
            const float part = per_n, per_far = 1 / GREATER(u1[i], 0.1f);
            const float far = (x1[i] * x1[i] + y1[i] * y1[i] + z1[i] * z1[i]) * per_far * per_far;
            const float common = (x0[i] * x1[i] + y0[i] * y1[i] + z0[i] * z1[i]) * per_n * per_far;
            const float jump_square = common * common / GREATER(GREATER(mean, far), 1e-30f);
            const int real = usable & (common > 0);
#else
            const float spread = n[i] * u2[i] - u1[i] * u1[i];
            usable &= spread > 1e-3f * n[i] * u2[i];
            const float per_spread = 1 / (usable ? spread : 1), part = u2[i] * per_spread;
            const float jump_x = (u2[i] * x0[i] - u1[i] * x1[i]) * per_spread;
            const float jump_y = (u2[i] * y0[i] - u1[i] * y1[i]) * per_spread;
            const float jump_z = (u2[i] * z0[i] - u1[i] * z1[i]) * per_spread;
            const float jump_square = jump_x * jump_x + jump_y * jump_y + jump_z * jump_z;
            const float both = (jump_x * x0[i] + jump_y * y0[i] + jump_z * z0[i]) * per_n;
            const int real = usable & (jump_square >= PART * PART * mean) & (2 * both >= jump_square);
#endif
            const float noise = part * v[i] * per_n * (1.0f / (SPACING * SPACING)) + floor_ * floor_;
            const float contrast = real ? jump_square / noise : 0;
            const int better = contrast > best[i];
            min_variance[i] = (usable & (noise < min_variance[i])) ? noise : min_variance[i];
            best[i] = better ? contrast : best[i];
            square[i] = better ? jump_square : square[i];
            error[i] = better ? noise : error[i];
            direction[i] = better ? w : direction[i];
        }
    }
    for (int i = 0; i < width; ++i) {
        const int unclear = (STEPS == 2) | (min_variance[i] > quiet * quiet);
        const int clear = LAST | !unclear;
        const float deviation = sqrt(error[i]), required = jump + (clear ? -1 : 0.5f) * deviation;
        const float enough = GREATER(GREATER(required, lowest), significance * deviation) + (STEPS == 2 ? bend : 0);
        const int open_pixel = FIRST || undecided[target + i], edge = open_pixel && best[i] > 0 && sqrt(square[i]) >= enough;
        strength[target + i] = edge ? sqrt(best[i]) : 0;
        directions[target + i] = direction[i];
        undecided[target + i] = open_pixel && unclear;
    }
}

float at(__global const float *strength, const int rows, const int columns, const int row, const int column)
{
    return row >= 0 && row < rows && column >= 0 && column < columns ? strength[row * columns + column] : 0;
}

// Whether a line of earlier passes is at or next to a pixel.
int guarded(
    __global const uchar *edges, const int rows, const int columns, const int row, const int column, const float cosine,
    const float sine)
{
    for (int y = GREATER(row - GUARD, 0); y <= LESSER(row + GUARD, rows - 1); ++y) {
        for (int x = GREATER(column - GUARD, 0); x <= LESSER(column + GUARD, columns - 1); ++x) {
            const int down = y - row, right = x - column;
            const float along = fabs(right * cosine + down * sine), across = fabs(down * cosine - right * sine);
            if (edges[y * columns + x] && along <= GUARD + 0.2f && across <= along + 0.1f) return 1;
        }
    }
    return 0;
}

__kernel void edges_thin(
    const int rows, const int columns, MAP strength, __global const uchar *restrict directions,
    __global const uchar *restrict edges, __global uchar *restrict added)
{
    EACH_PIXEL {
        float here = strength[p];
        added[p] = FIRST ? 0 : edges[p];
        if (!(here > 0)) continue;
        const int row = p / columns, column = p % columns;
        const float angle = M_PI_F / DIRECTIONS * directions[p], cosine = cos(angle), sine = sin(angle);
        for (int step = 1; step <= REACH; ++step) {
            const int right = (int)floor(step * cosine + 0.5f), down = (int)floor(step * sine + 0.5f);
            if (at(strength, rows, columns, row + down, column + right) > here) here = 0;
            if (at(strength, rows, columns, row - down, column - right) >= here) here = 0;
        }
        if (!(here > 0)) continue;
        if (FIRST || !guarded(edges, rows, columns, row, column, cosine, sine)) added[p] = 1;
    }
}
#endif

// Whether a pixel in contact has one of four neighbours out of contact; the picture's border does not count.
int ends(__global const uchar *clean, const int rows, const int columns, const int row, const int column)
{
    const int p = row * columns + column;
    return clean[p] && ((row > 0 && !clean[p - columns]) || (row + 1 < rows && !clean[p + columns])
        || (column > 0 && !clean[p - 1]) || (column + 1 < columns && !clean[p + 1]));
}

__kernel void edges_bound(
    const int rows, const int columns, __global const uchar *restrict clean, __global const uchar *restrict edges,
    __global uchar *restrict drawn)
{
    EACH_PIXEL {
        const int row = p / columns, column = p % columns;
        int edge = ends(clean, rows, columns, row, column);
        if (!edge && edges[p] && clean[p]) {
            edge = 1;
            for (int y = GREATER(row - 1, 0); y <= LESSER(row + 1, rows - 1); ++y) {
                for (int x = GREATER(column - 1, 0); x <= LESSER(column + 1, columns - 1); ++x)
                    edge &= !ends(clean, rows, columns, y, x);
            }
        }
        drawn[p] = edge;
    }
}
