// The contrast around each pixel, and its peak over the frames. Specification: focus.py.
//
// TILE     pixels of one work-item: 1 on a GPU, many on a CPU
// FRAME    type of a sample

#pragma OPENCL FP_CONTRACT OFF
#include "common.clh"

__kernel void focus_scan(
    __global const FRAME *restrict frames, const int count, const int rows, const int columns, const int stride,
    const int first, const int radius, const int reach, __global int *restrict best, OUT peak, OUT recent)
{
    const int pixels = rows * columns, low = get_global_id(0) * TILE, end = min(pixels, low + TILE);
    for (int t = first; t < first + count; ++t) {
        __global const FRAME *restrict frame = frames + (size_t)(t - first) * pixels;
        for (int p = low; p < end; ++p) {
            const int row = p / columns, column = p % columns;
            const int top = max(row - radius, 0), bottom = min(row + radius, rows - 1);
            const int left = max(column - radius, 0), right = min(column + radius, columns - 1);
            const float middle = frame[p];  // squares of differences from it lose no digits
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
            const size_t plane = stride;
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

#define NO_PEAK 2
#define IN_FOCUS 1
#define AT_AN_END 3
#define INVALID 0

#define SIGNAL(k) (peak[(k) * plane + p] - noisy)

// Inverse variance of the signal's logarithm for noise of variance 1, from a non-central chi-square.
#define WEIGHT(signal) ((signal) > 0 ? (signal) * ((signal) / (2 * noisy + 4 * (signal))) : 0)

// One of the points of the fit; used in a loop over k.
#define POINT                                                                     \
    const float signal = SIGNAL(k), weight = WEIGHT(signal), place = at[k];       \
    if (!(weight > 0)) continue;

__kernel void focus_fit(
    const int rows, const int columns, const int stride, const int count, const int radius, const int reach, const float variance,
    const float least_contrast, const float least_curvature, MAP places, MAP travel, const float unit,
    __global const int *restrict best, MAP peak, OUT height, OUT spread, OUT gain, OUT misfit, OUT sharpness,
    __global uchar *restrict status)
{
    const int pixels = rows * columns, low = get_global_id(0) * TILE, end = min(pixels, low + TILE);
    const size_t plane = stride;
    for (int p = low; p < end; ++p) {
        const int row = p / columns, column = p % columns, sharpest = best[p];
        const int high = min(row + radius, rows - 1) - max(row - radius, 0) + 1;
        const int wide = min(column + radius, columns - 1) - max(column - radius, 0) + 1;
        const float freedom = high * wide - 1, noisy = freedom * variance, top = SIGNAL(reach);
        MAP at = places + sharpest * (2 * reach + 1);

        // Polynomials that are orthogonal over the positions, and their sums with the logarithms.
        float total = 0, mean = 0, norm = 0, skew = 0, bent = 0, level = 0, along = 0, across = 0;
        int points = 0;
        for (int k = 0; k <= 2 * reach; ++k) {
            POINT
            total += weight;
            mean += weight * place;
            points += 1;
        }
        mean /= total;
        for (int k = 0; k <= 2 * reach; ++k) {
            POINT
            const float first = place - mean;
            norm += weight * first * first;
            skew += weight * first * first * first;
        }
        skew /= norm;
        for (int k = 0; k <= 2 * reach; ++k) {
            POINT
            const float first = place - mean, second = first * first - skew * first - norm / total;
            const float value = log(signal / top);
            bent += weight * second * second;
            level += weight * value;
            along += weight * value * first;
            across += weight * value * second;
        }
        level /= total;
        along /= norm;
        across /= bent;
        float residual = 0, taken = 0, each = 0;
        for (int k = 0; k <= 2 * reach; ++k) {
            POINT
            const float first = place - mean, second = first * first - skew * first - norm / total;
            const float missed = log(signal / top) - level - along * first - across * second;
            const float moves = weight * (first / norm - along / across * second / bent);
            residual += weight * missed * missed;
            taken += weight * weight * (1 / total + first * first / norm + second * second / bent);
            each += moves * moves;
        }
        const float vertex = mean + skew / 2 - along / (2 * across), scale = unit / (2 * across), free = total - taken;
        const float curvature = across < 0 ? across * across * bent : 0;
        int found = points > 2 && top > least_contrast * variance * sqrt(2 * freedom)
            && curvature > least_curvature * least_curvature * variance;
        const float chi = 1 - 2 / (9 * (points - 3.0f));
        misfit[p] = found && points > 3 && free > 0
            ? (residual / (chi * chi * chi) - (points - 3) * variance) / free : NAN;
        const float before = at[reach - 1], after = at[reach + 1];
        found &= vertex > LESSER(LESSER(before, after), 0) && vertex < GREATER(GREATER(before, after), 0);
        int code = found ? IN_FOCUS : NO_PEAK;
        if (sharpest == 0 || sharpest == count - 1) code = AT_AN_END;
        if (!(top - top == 0)) code = INVALID;
        found = code == IN_FOCUS;
        status[p] = code;
        height[p] = found ? -(travel[sharpest] + unit * vertex) : NAN;
        spread[p] = found ? (1 / norm + along / across * (along / across) / bent) * scale * scale : NAN;
        gain[p] = each * scale * scale;
        sharpness[p] = top < 0 ? 0 : sqrt(top / GREATER(freedom, 1));
    }
}
