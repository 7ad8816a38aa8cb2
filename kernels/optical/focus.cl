// The contrast around each pixel, and its peak over the frames. Specification: focus.py.
//
// TILE     pixels of one work-item: 1 on a GPU, many on a CPU
// FRAME    type of a sample
// BITS     its width

#pragma OPENCL FP_CONTRACT OFF
#include "common.clh"

#define STRIP (TILE < 256 ? TILE : 256)  // pixels of a row that are processed together
#define CHUNK (STRIP < 64 ? STRIP : 64)
#define WIDEST 50

#define CHOSEN(mask, yes, no) (((mask) & (yes)) | (~(mask) & (no)))

// Updates the peaks of some pixels, from `place` on, by their contrast in frame t. Loops over copies vectorise.
__attribute__((always_inline)) void update(
    const float *sharp, const size_t place, const int size, const size_t plane, const int t, const int reach,
    __global int *restrict best, OUT top, OUT recent)
{
    // Numbers are chosen by bits: conditional copies of array elements become branches.
    int now[CHUNK], most[CHUNK], where[CHUNK], last[CHUNK], before[CHUNK], after[CHUNK], better[CHUNK], since[CHUNK];
    int changed = 0;
    for (int i = 0; i < size; ++i) now[i] = as_int(sharp[i]);
    for (int i = 0; i < size; ++i) most[i] = as_int(top[place + i]);
    for (int i = 0; i < size; ++i) where[i] = best[place + i];
    for (int i = 0; i < size; ++i) {
        const float value = as_float(now[i]), largest = as_float(most[i]);
        better[i] = -((t == 0) | (value > largest) | (largest != largest));
        since[i] = ~better[i] & (t - where[i]);
        changed |= since[i] <= reach;
    }
    if (!changed) return;
    for (int i = 0; i < size; ++i) top[place + i] = as_float(CHOSEN(better[i], now[i], most[i]));
    for (int i = 0; i < size; ++i) best[place + i] = CHOSEN(better[i], t, where[i]);
    for (int k = 1; k <= reach; ++k) {
        OUT earlier = recent + (t - k + (k > t ? reach : 0)) % reach * plane + place;
        const int none = as_int(NAN);
        for (int i = 0; i < size; ++i) last[i] = k > t ? none : as_int(earlier[i]);
        for (int i = 0; i < size; ++i) before[i] = as_int(top[place + i - k * plane]);
        for (int i = 0; i < size; ++i) after[i] = as_int(top[place + i + k * plane]);
        for (int i = 0; i < size; ++i) before[i] = CHOSEN(better[i], last[i], before[i]);
        for (int i = 0; i < size; ++i) after[i] = CHOSEN(better[i], none, CHOSEN(-(since[i] == k), now[i], after[i]));
        for (int i = 0; i < size; ++i) top[place + i - k * plane] = as_float(before[i]);
        for (int i = 0; i < size; ++i) top[place + i + k * plane] = as_float(after[i]);
    }
}

void remember(
    const float *sharp, const size_t place, const int width, const size_t plane, const int t, const int reach,
    __global int *restrict best, OUT peak, OUT recent)
{
    OUT top = peak + reach * plane;
    int low = 0;
    for (; low + CHUNK <= width; low += CHUNK)
        update(sharp + low, place + low, CHUNK, plane, t, reach, best, top, recent);
    if (low < width) update(sharp + low, place + low, width - low, plane, t, reach, best, top, recent);
    OUT now = recent + t % reach * plane + place;
    for (int i = 0; i < width; ++i) now[i] = sharp[i];
}

// Copies the last samples of pixels whose sharpest frame is the one in the middle of these.
void keep_own(
    const float *own, const size_t place, const int width, const size_t plane, const int t, const int reach,
    __global const int *restrict best, OUT detail, OUT last)
{
    const int kept = 2 * reach + 1;
    OUT now = last + t % kept * plane + place;
    for (int i = 0; i < width; ++i) now[i] = own[i];
    for (int low = 0; low < width; low += CHUNK) {
        const size_t start = place + low;
        const int size = min(CHUNK, width - low);
        int whole[CHUNK], some = 0;
        for (int i = 0; i < size; ++i) some |= whole[i] = -(best[start + i] == t - reach);
        if (!some) continue;
        for (int k = 0; k < kept; ++k) {
            OUT from = last + (t + 1 + k) % kept * plane + start;
            OUT to = detail + k * plane + start;
            for (int i = 0; i < size; ++i) to[i] = as_float(CHOSEN(whole[i], as_int(from[i]), as_int(to[i])));
        }
    }
}

#define MOVING_SUMS (TILE > 1 && BITS < 32)
#if MOVING_SUMS
// Sums along columns move down row by row, and their sums along rows to the right, in integers.
#if BITS == 8
typedef int Sum;
#else
typedef long Sum;
#endif

void add_row(__global const FRAME *row, const int width, const int sign, Sum *restrict sums, Sum *restrict squares)
{
    for (int i = 0; i < width; ++i) {
        const Sum sample = row[i];
        sums[i] += sign * sample;
        squares[i] += sign * sample * sample;
    }
}
#endif

__kernel void focus_scan(
    __global const FRAME *restrict frames, const int count, const int rows, const int columns, const int above,
    const int stride,
    const int first, const int radius, const int reach, const int every, __global int *restrict best, OUT peak,
    OUT recent, OUT detail, OUT last)
{
    const int pixels = rows * columns;
#if TILE == 1
    const int row_low = get_global_id(0) / columns, row_end = min(row_low + 1, rows);
    const int column_low = get_global_id(0) % columns, column_end = column_low + 1;
#else
    const long items = (pixels + TILE - 1) / TILE, item = get_global_id(0);
    const int row_low = min(item, items) * rows / items, row_end = min(item + 1, items) * rows / items;
    const int column_low = 0, column_end = columns;
#endif
    for (int t = first; t < first + count; ++t) {
        __global const FRAME *restrict frame = frames + (size_t)(t - first) * pixels;
        for (int base = column_low; base < column_end; base += STRIP) {
            const int width = min(STRIP, column_end - base);
            int wide[STRIP];
            for (int i = 0; i < width; ++i)
                wide[i] = LESSER(base + i + radius, columns - 1) - GREATER(base + i - radius, 0) + 1;
#if MOVING_SUMS
            Sum sums[STRIP + 2 * WIDEST + 1], squares[STRIP + 2 * WIDEST + 1];
            const int leftmost = max(base - radius, 0), used = min(base + width + radius, columns) - leftmost;
            const int start = leftmost - (base - radius);
            for (int i = 0; i < width + 2 * radius + 1; ++i) sums[i] = squares[i] = 0;
            for (int y = max(row_low - radius, 0); y < min(row_low + radius, rows); ++y)
                add_row(frame + (size_t)y * columns + leftmost, used, 1, sums + start, squares + start);
#endif
            for (int row = row_low; row < row_end; ++row) {
                const int top = max(row - radius, 0), bottom = min(row + radius, rows - 1);
                __global const FRAME *restrict middle = frame + (size_t)row * columns + base;
                float sharp[STRIP], own[STRIP], sum[STRIP], square[STRIP];  // of differences from the middle, which lose no digits
#if MOVING_SUMS
                if (row + radius < rows)
                    add_row(frame + (size_t)(row + radius) * columns + leftmost, used, 1, sums + start, squares + start);
                if (row - radius > 0 && row > row_low)
                    add_row(frame + (size_t)(row - radius - 1) * columns + leftmost, used, -1, sums + start, squares + start);
                Sum total[STRIP], all[STRIP], moving = 0, moving_square = 0;
                for (int i = 0; i < 2 * radius; ++i) {
                    moving += sums[i];
                    moving_square += squares[i];
                }
                for (int i = 0; i < width; ++i) {
                    total[i] = moving += sums[i + 2 * radius];
                    all[i] = moving_square += squares[i + 2 * radius];
                    moving -= sums[i];
                    moving_square -= squares[i];
                }
                for (int i = 0; i < width; ++i) {
                    const Sum size = (bottom - top + 1) * wide[i], sample = middle[i];
                    sum[i] = total[i] - size * sample;
                    square[i] = all[i] - 2 * sample * total[i] + size * sample * sample;
                }
#else
                for (int i = 0; i < width; ++i) sum[i] = square[i] = 0;
                for (int y = top; y <= bottom; ++y)
                    for (int x = -radius; x <= radius; ++x) {
                        __global const FRAME *restrict other = frame + (size_t)y * columns + base + x;
                        const int end = min(width, columns - base - x);
                        for (int i = max(0, -base - x); i < end; ++i) {
                            const float difference = other[i] - (float)middle[i];
                            sum[i] += difference;
                            square[i] += difference * difference;
                        }
                    }
#endif
                for (int i = 0; i < width; ++i) {
                    const float size = (bottom - top + 1) * wide[i];
                    sharp[i] = square[i] - sum[i] * sum[i] / size;
                    own[i] = -sum[i] / size;
                }
                remember(sharp, row * columns + base, width, stride, t, reach, best, peak, recent);
                if ((above + row) % every == 0) keep_own(own, row * columns + base, width, stride, t, reach, best, detail, last);
            }
        }
    }
}

#define NO_PEAK 2
#define IN_FOCUS 1
#define AT_AN_END 3
#define INVALID 0

#define BLOCK (TILE < 64 ? TILE : 64)
#define EACH for (int i = 0, p = base; i < width; ++i, ++p)

// Natural logarithm of a positive number, by the series of its inverse hyperbolic tangent.
float logarithm(const float x)
{
    const int power = (as_int(x) - 0x3f3504f3) >> 23;  // x / 2^power is between root 1/2 and root 2
    const float part = as_float(as_int(x) - (power << 23)), s = (part - 1) / (part + 1), square = s * s;
    const float sum = s * (2 + square * (2 / 3.0f + square * (2 / 5.0f + square * (2 / 7.0f + square * (2 / 9.0f)))));
    return power * M_LN2_F + sum;
}

// exp(x) - 1 from -4 to 0, by the series at x / 8 and (1 + y)^2 - 1 = y (2 + y).
float below_one(const float x)
{
    const float part = (x < -4 ? -4 : x) / 8;
    float y = part * (1 + part / 2 * (1 + part / 3 * (1 + part / 4)));
    for (int i = 0; i < 3; ++i) y *= 2 + y;
    return y;
}

#define SIGNAL(k) (peak[(k) * plane + p] - noisy[i])

// One of the points of the fit; its weight is the inverse variance of the logarithm for noise of variance 1, from a
// non-central chi-square, or 0 without a signal.
#define POINT                                                                                                   \
    const float signal = SIGNAL(k), place = places[best[p] * (2 * reach + 1) + k];                              \
    const float weight = signal > 0 ? signal * (signal / (2 * noisy[i] + 4 * signal)) : 0;
// The same, and the polynomials that are orthogonal over the positions.
#define POLYNOMIALS                                                                                             \
    POINT const float line = place - mean[i], parabola = line * line - skew[i] * line - norm[i] / total[i];     \
    const float value = weight > 0 ? logarithm(signal / top[i]) : 0;

__kernel void focus_fit(
    const int rows, const int columns, const int above, const int stride, const int count, const int radius, const int reach,
    const int every, const float variance,
    const float least_contrast, const float least_curvature, MAP places, MAP travel, const float unit,
    __global const int *restrict best, MAP peak, MAP detail, OUT height, OUT spread, OUT gain, OUT misfit,
    OUT sharpness, OUT shifted, OUT shifted_noise, OUT texture, OUT texture_noise, OUT left, __global uchar *restrict status)
{
    const int pixels = rows * columns, low = get_global_id(0) * TILE, limit = min(pixels, low + TILE);
    const size_t plane = stride;
    for (int base = low; base < limit; base += BLOCK) {
        const int width = min(BLOCK, limit - base);
        float freedom[BLOCK], noisy[BLOCK], top[BLOCK], points[BLOCK], total[BLOCK], mean[BLOCK], norm[BLOCK], skew[BLOCK];
        float bent[BLOCK], level[BLOCK], along[BLOCK], across[BLOCK], residual[BLOCK], taken[BLOCK], moves[BLOCK];
        float vertex[BLOCK], shape[BLOCK], slope[BLOCK], sample[BLOCK], shape2[BLOCK], mixed[BLOCK], slope2[BLOCK];
        float with_shape[BLOCK], with_slope[BLOCK], square[BLOCK];
        EACH {
            const int row = p / columns, column = p % columns;
            const int high = LESSER(row + radius, rows - 1) - GREATER(row - radius, 0) + 1;
            const int wide = LESSER(column + radius, columns - 1) - GREATER(column - radius, 0) + 1;
            freedom[i] = high * wide - 1;
            noisy[i] = freedom[i] * variance;
            top[i] = SIGNAL(reach);
            points[i] = total[i] = mean[i] = norm[i] = skew[i] = bent[i] = 0;
            level[i] = along[i] = across[i] = residual[i] = taken[i] = moves[i] = 0;
            shape[i] = slope[i] = sample[i] = shape2[i] = mixed[i] = slope2[i] = 0;
            with_shape[i] = with_slope[i] = square[i] = 0;
        }
        for (int k = 0; k <= 2 * reach; ++k) EACH {
            POINT
            total[i] += weight;
            mean[i] += weight * place;
            points[i] += weight > 0 ? 1 : 0;
        }
        EACH mean[i] /= total[i];
        for (int k = 0; k <= 2 * reach; ++k) EACH {
            POINT
            const float line = place - mean[i];
            norm[i] += weight * line * line;
            skew[i] += weight * line * line * line;
        }
        EACH skew[i] /= norm[i];
        for (int k = 0; k <= 2 * reach; ++k) EACH {
            POLYNOMIALS
            bent[i] += weight * parabola * parabola;
            level[i] += weight * value;
            along[i] += weight * value * line;
            across[i] += weight * value * parabola;
        }
        EACH {
            level[i] /= total[i];
            along[i] /= norm[i];
            across[i] /= bent[i];
        }
        for (int k = 0; k <= 2 * reach; ++k) EACH {
            POLYNOMIALS
            const float missed = weight > 0 ? value - level[i] - along[i] * line - across[i] * parabola : 0;
            const float move = weight * (line / norm[i] - along[i] / across[i] * parabola / bent[i]);
            residual[i] += weight * missed * missed;
            taken[i] += weight * weight * (1 / total[i] + line * line / norm[i] + parabola * parabola / bent[i]);
            moves[i] += move * move;
        }
        EACH vertex[i] = mean[i] + skew[i] / 2 - along[i] / (2 * across[i]);
        // The pixel's own samples, minus the sharpest one, are a constant + b shape + m slope: the sums of this fit.
        int some = 0;
        EACH some |= (above + p / columns) % every == 0;
        for (int k = 0; some && k <= 2 * reach; ++k) EACH {
            const float place = places[best[p] * (2 * reach + 1) + k] - vertex[i];
            const float part = below_one(across[i] / 2 * place * place), along_it = -across[i] * place * (1 + part);
            const float own = detail[k * plane + p] - detail[reach * plane + p];
            shape[i] += part;
            slope[i] += along_it;
            sample[i] += own;
            shape2[i] += part * part;
            mixed[i] += part * along_it;
            slope2[i] += along_it * along_it;
            with_shape[i] += part * own;
            with_slope[i] += along_it * own;
            square[i] += own * own;
        }
        EACH {
            const int sharpest = best[p];
            MAP at = places + sharpest * (2 * reach + 1);
            const float scale = unit / (2 * across[i]), free = total[i] - taken[i];
            const float curvature = across[i] < 0 ? across[i] * across[i] * bent[i] : 0;
            int fitted = points[i] > 2 && top[i] > least_contrast * variance * sqrt(2 * freedom[i])
                && curvature > least_curvature * least_curvature * variance;
            const float chi = 1 - 2 / (9 * (points[i] - 3));
            misfit[p] = fitted && points[i] > 3 && free > 0
                ? (residual[i] / (chi * chi * chi) - (points[i] - 3) * variance) / free : NAN;
            const float before = at[reach - 1], after = at[reach + 1];
            fitted &= vertex[i] > LESSER(LESSER(before, after), 0) && vertex[i] < GREATER(GREATER(before, after), 0);
            int code = fitted ? IN_FOCUS : NO_PEAK;
            if (sharpest == 0 || sharpest == count - 1) code = AT_AN_END;
            if (!(top[i] - top[i] == 0)) code = INVALID;
            fitted = code == IN_FOCUS;
            status[p] = code;
            height[p] = fitted ? -(travel[sharpest] + unit * vertex[i]) : NAN;
            const float tilt = along[i] / across[i];
            spread[p] = fitted ? (1 / norm[i] + tilt * tilt / bent[i]) * scale * scale : NAN;
            gain[p] = moves[i] * scale * scale;
            sharpness[p] = top[i] < 0 ? 0 : sqrt(top[i] / GREATER(freedom[i], 1));
            const float n = 2 * reach + 1, a = shape2[i] - shape[i] * shape[i] / n;
            const float b = mixed[i] - shape[i] * slope[i] / n, c = slope2[i] - slope[i] * slope[i] / n;
            const float u = with_shape[i] - shape[i] * sample[i] / n, v = with_slope[i] - slope[i] * sample[i] / n;
            const float determinant = a * c - b * b, by_shape = (c * u - b * v) / determinant;
            const float by_slope = (a * v - b * u) / determinant;
            const float unexplained = square[i] - sample[i] * sample[i] / n - by_shape * u - by_slope * v;
            const float shift2 = by_slope * by_slope * unit * unit, texture2 = by_shape * by_shape;
            const int own = fitted && (above + p / columns) % every == 0 && sharpest >= reach && sharpest + reach < count
                && shift2 - shift2 == 0 && texture2 - texture2 == 0;
            const float noise = own && reach > 1 ? GREATER(unexplained, 0) / (n - 3) : 0;
            shifted[p] = own ? shift2 : 0;
            shifted_noise[p] = noise > 0 ? noise * a / determinant * unit * unit : 0;
            texture[p] = own ? texture2 : 0;
            texture_noise[p] = noise > 0 ? noise * c / determinant : 0;
            left[p] = noise;
        }
    }
}
