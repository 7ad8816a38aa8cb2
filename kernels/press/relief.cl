// What relief inside a pixel, and errors of levels, add to the standard deviations of heights. Specification:
// relief.py.
//
// TILE     pixels of one work-item of other kernels: 1 on a GPU, many on a CPU

#pragma OPENCL FP_CONTRACT OFF
#include "common.clh"

#define ACROSS (TILE < 256 ? TILE : 256)  // columns of one work-item
#define DOWN 16  // rows of one work-item

#define OR_MIDDLE(x) ((x) == (x) ? (x) : middle)

// A work-item computes the bends at its pixels and next to them, and then their mean over 3 x 3 pixels.
__kernel void relief_sigma(
    const int rows, const int columns, MAP height, MAP sigma, const float across, const float along,
    const float shape_factor,
    const float twice, const float reach, const float per_slope, const float offset, OUT combined)
{
    const int tiles = (columns + ACROSS - 1) / ACROSS, item = get_global_id(0);
    const int base = item % tiles * ACROSS, top = item / tiles * DOWN;
    const int width = min(ACROSS, columns - base), count = min(DOWN, rows - top);
    if (top >= rows) return;

    // Heights of two rows and columns more on each side: outside of the picture those at its border.
    float heights[DOWN + 4][ACROSS + 4], bends[DOWN + 2][ACROSS + 2], slopes[DOWN + 2][ACROSS + 2];
    for (int r = 0; r < count + 4; ++r) {
        const int row = top + r - 2;
        MAP line = height + (size_t)LIMITED(row, 0, rows - 1) * columns;
        for (int p = 0; p < width; ++p) heights[r][p + 2] = line[base + p];
        for (int p = 0; p < 2; ++p) heights[r][p] = line[GREATER(base + p - 2, 0)];
        for (int p = 0; p < 2; ++p) heights[r][width + 2 + p] = line[LESSER(base + width + p, columns - 1)];
    }
    for (int r = 0; r < count + 2; ++r) {
        const float *upper = heights[r] + 1, *inner = heights[r + 1] + 1, *lower = heights[r + 2] + 1;
        for (int p = 0; p < width + 2; ++p) {
            const float middle = inner[p];
            const float left = OR_MIDDLE(inner[p - 1]), right = OR_MIDDLE(inner[p + 1]);
            const float above = OR_MIDDLE(upper[p]), below = OR_MIDDLE(lower[p]);
            const float diagonal = OR_MIDDLE(upper[p - 1]) + OR_MIDDLE(lower[p + 1]);
            const float x = right - left, y = below - above, square = x * x + y * y;  // twice the slopes
            const float xx = left + right - 2 * middle, yy = above + below - 2 * middle;
            const float xy = diagonal - OR_MIDDLE(upper[p + 1]) - OR_MIDDLE(lower[p - 1]);  // four times
            const float level = (xx * y * y + yy * x * x - 0.5f * xy * x * y) / (square + 1e-30f), steep = xx + yy - level;
            const float spread = reach * steep * steep, near = spread * spread / (spread * spread + square * square + 1e-36f);
            const float both = GREATER(2 * level * steep, 0);
            const float bend = along * level * level + (across * near + shape_factor) * steep * steep + twice * near * both;
            bends[r][p] = middle == middle ? bend : 0;
            slopes[r][p] = per_slope * square;
        }
    }
    for (int r = 0; r < count; ++r) {
        const size_t first = (size_t)(top + r) * columns + base;
        const float *upper = bends[r], *own = bends[r + 1] + 1, *lower = bends[r + 2], *slope = slopes[r + 1] + 1;
        float sums[ACROSS + 2];  // of three rows
        for (int p = 0; p < width + 2; ++p) sums[p] = upper[p] + own[p - 1] + lower[p];
        for (int p = 0; p < width; ++p) {
            const float mean = (sums[p] + sums[p + 1] + sums[p + 2]) * (1 / 9.0f), bend = GREATER(own[p], mean);
            const float before = sigma[first + p];
            sums[p] = before * before + bend + slope[p] + offset;
        }
        for (int p = 0; p < width; ++p) combined[first + p] = sums[p] * rough_inverse_root(sums[p]);  // faster alone
    }
}
