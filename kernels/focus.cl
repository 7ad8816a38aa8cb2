// The contrast around each pixel, and its peak over the frames. Specification: focus.py.
//
// TILE     pixels of one work-item; 1 where an item is a lane, many where it is a core's loop
// FRAME    type of a sample

#pragma OPENCL FP_CONTRACT OFF
#include "common.clh"

__kernel void focus_scan(
    __global const FRAME *restrict frames, const int count, const int rows, const int columns, const int first,
    const int radius, const int reach, __global int *restrict best, OUT peak, OUT recent)
{
    const int pixels = rows * columns, low = get_global_id(0) * TILE, end = min(pixels, low + TILE);
    for (int t = first; t < first + count; ++t) {
        __global const FRAME *restrict frame = frames + (size_t)(t - first) * pixels;
        for (int p = low; p < end; ++p) {
            const int row = p / columns, column = p % columns;
            const int top = max(row - radius, 0), bottom = min(row + radius, rows - 1);
            const int left = max(column - radius, 0), right = min(column + radius, columns - 1);
            const float middle = frame[p];  // of differences, the squares lose nothing
            float sum = 0, square = 0;
            for (int y = top; y <= bottom; ++y)
                for (int x = left; x <= right; ++x) {
                    const float difference = frame[(size_t)y * columns + x] - middle;
                    sum += difference;
                    square += difference * difference;
                }
            const float sharp = square - sum * sum / ((bottom - top + 1) * (right - left + 1));

            OUT at = peak + p;
            OUT before = recent + p;
            const size_t plane = pixels;
            const int since = t - best[p];
            if (t == 0 || sharp > at[reach * plane] || at[reach * plane] != at[reach * plane]) {
                for (int k = 1; k <= reach; ++k) {
                    at[(reach - k) * plane] = k <= t ? before[((t - k) % reach) * plane] : NAN;
                    at[(reach + k) * plane] = NAN;
                }
                at[reach * plane] = sharp;
                best[p] = t;
            } else if (since <= reach)
                at[(reach + since) * plane] = sharp;
            before[(t % reach) * plane] = sharp;
        }
    }
}
