// Onset of the light state: the first crossing of the threshold that holds. Specification: onset.py.
//
// FRAME   type of a sample
// COUNT   unsigned type as wide as FRAME, so that the scan's inner loop keeps one vector width, or wider
//         where `hold` needs it
// SPAN    frames that a COUNT can count
// FLOATS  1 where samples can be NaN
// TILE    pixels of one work-item; 1 where an item is a lane, many where it is a core's loop

#pragma OPENCL FP_CONTRACT OFF

#define DARK -1
#define INVALID -2

#if FLOATS
#define USABLE(sample) (fabs(sample) <= MAXFLOAT)
#define LESSER(a, b) fmin(a, b)
#else
#define USABLE(sample) 1
#define LESSER(a, b) min(a, b)
#endif

__kernel void onset_scan(
    __global const FRAME *restrict frames, const int count, const int pixels, const int first, const int hold,
    const float tolerance, __global const float *restrict level, __global const FRAME *restrict light,
    __global int *restrict onset, __global int *restrict below, __global FRAME *restrict last,
    __global FRAME *restrict before, __global FRAME *restrict at, __global FRAME *restrict after)
{
    const int base = get_global_id(0) * TILE;
    if (base >= pixels) return;
    const int width = min(TILE, pixels - base);

    FRAME least[TILE];
    COUNT wanted[TILE];  // light frames still missing from a run that holds; 0: the pixel is decided
    COUNT open[TILE];    // frames of this span that left the pixel undecided
    COUNT broken[TILE];
    int waited[TILE];    // frames of this block that left the pixel undecided

    int busy = 0;
    for (int p = 0; p < width; ++p) {
        const int start = onset[base + p];
        const int run = start < 0 ? 0 : min(first - start, hold);
        least[p] = light[base + p];
        wanted[p] = start == INVALID ? 0 : hold - run;
        broken[p] = 0;
        waited[p] = 0;
        busy |= start == DARK || (start >= 0 && max(hold, 3) > first - start);
    }
    if (!busy) return;  // every pixel is decided and has its samples: nothing to read

    for (int span = 0; span < count; span += SPAN) {
        const int end = min(count, span + SPAN);
        for (int p = 0; p < width; ++p) open[p] = 0;
        for (int t = span; t < end; ++t) {
            __global const FRAME *restrict frame = frames + (size_t)t * pixels + base;
            for (int p = 0; p < width; ++p) {
                const FRAME sample = frame[p];
                const COUNT left = wanted[p];
                const COUNT next = sample >= least[p] ? (COUNT)(left - 1) : (COUNT)hold;
#if FLOATS
                broken[p] |= (left != 0) & !USABLE(sample);
#endif
                wanted[p] = left != 0 ? next : (COUNT)0;
                open[p] += wanted[p] != 0;
            }
        }
        for (int p = 0; p < width; ++p) waited[p] += open[p];
    }

    for (int p = 0; p < width; ++p) {
        const int pixel = base + p;
        const int known = onset[pixel];
        const int end = first + count;
        int start = known;
        if (broken[p])
            start = INVALID;
        else if (wanted[p] != 0)
            start = wanted[p] == (COUNT)hold ? DARK : end - (hold - (int)wanted[p]);
        else if (known != INVALID && (known < 0 || hold > first - known))
            start = first + waited[p] - hold + 1;
        onset[pixel] = start;

        __global const FRAME *restrict samples = frames + pixel;
        if (start >= first) {
            before[pixel] = start > first ? samples[(size_t)(start - 1 - first) * pixels] : last[pixel];
            at[pixel] = samples[(size_t)(start - first) * pixels];
        }
        if (start >= 0 && start + 1 >= first && start + 1 < end)
            after[pixel] = samples[(size_t)(start + 1 - first) * pixels];
        if (start >= 0 && start + 2 >= first && start + 2 < end)
            after[pixel] = LESSER(after[pixel], samples[(size_t)(start + 2 - first) * pixels]);
        // Back from the frame before the run to the last one that was surely dark; most often that one is it.
        int dark = (start >= 0 ? start : end) - 1;
        const int decided = known == INVALID || (known >= 0 && hold <= first - known);
        while (!decided && dark >= max(first, 1)) {
            const FRAME sample = samples[(size_t)(dark - first) * pixels];
            if (sample < least[p] && sample <= level[pixel] - tolerance) break;
            --dark;
        }
        if (!decided && dark >= max(first, 1)) below[pixel] = dark;
        last[pixel] = samples[(size_t)(count - 1) * pixels];
    }
}

// Travel is held as the sum of two floats, so that a height is exact to its last bit without float64.
// Dekker (1971); Knuth, TAOCP 2, 4.2.2.

float2 two_sum(const float a, const float b)
{
    const float sum = a + b;
    const float part = sum - a;
    return (float2)(sum, (a - (sum - part)) + (b - part));
}

float2 two_product(const float a, const float b)
{
    const float product = a * b;
    return (float2)(product, fma(a, b, -product));
}

float2 pair_sum(const float2 a, const float2 b)
{
    const float2 sum = two_sum(a.x, b.x);
    const float2 rest = two_sum(a.y, b.y);
    const float2 middle = two_sum(sum.x, sum.y + rest.x);
    return two_sum(middle.x, middle.y + rest.y);
}

float2 pair_product(const float2 a, const float2 b)
{
    const float2 product = two_product(a.x, b.x);
    return two_sum(product.x, product.y + (a.x * b.y + a.y * b.x));
}

float2 pair_quotient(const float2 a, const float2 b)
{
    const float guess = a.x / b.x;
    const float2 rest = pair_sum(a, -pair_product(b, (float2)(guess, 0)));
    return two_sum(guess, rest.x / b.x);
}

__kernel void onset_heights(
    const int pixels, const int count, __global const int *restrict onset, __global const int *restrict below,
    __global const FRAME *restrict before, __global const FRAME *restrict at,
    __global const FRAME *restrict after, __global const float *restrict level,
    __global const float *restrict dark, __global const float2 *restrict travel, const float dark_tolerance,
    const float light_tolerance, const float noise, const int subframe, __global float *restrict height,
    __global float *restrict sigma, __global uchar *restrict status)
{
    const int base = get_global_id(0) * TILE;
    const int end = min(pixels, base + TILE);
    for (int p = base; p < end; ++p) {
        const int start = onset[p];
        height[p] = NAN;
        sigma[p] = NAN;
        status[p] = start == INVALID ? 0 : start == DARK ? 2 : start == 0 ? 3 : 1;
        if (status[p] != 1) continue;

        const float low = before[p], high = at[p];
        const float settled = start + 1 < count ? (float)after[p] : high;
        const float2 width = pair_sum(travel[start], -travel[start - 1]);
        const int from_dark = low <= dark[p] + dark_tolerance, to_light = high >= settled - light_tolerance;

        const float2 step = two_sum(high, -low);
        const float2 crossed = pair_quotient(two_sum(fmin(level[p], high), -low), step);
        const float rest = 1 - crossed.x;
        const float known = width.x * noise * sqrt(crossed.x * crossed.x + rest * rest) / step.x;
        // Near its level for longer than its step takes, it may have crossed at any time since it was dark.
        const int hovered = step.x <= light_tolerance || (start - 2 - below[p]) * step.x > 2.5f * light_tolerance;
        const float interval = hovered ? pair_sum(travel[start], -travel[below[p]]).x : width.x;
        const float guessed = 0.5f * interval / sqrt(3.0f);
        float2 share = crossed;
        sigma[p] = from_dark || to_light ? sqrt(known * known + guessed * guessed) : known;
        if (from_dark && to_light) share = (float2)(0.5f, 0);
        if ((from_dark && to_light) || hovered) sigma[p] = guessed;
        if (!subframe) {
            share = (float2)(1, 0);
            sigma[p] = 2 * guessed;
        }
        const float2 crossing = pair_sum(travel[start - 1], pair_product(width, share));
        height[p] = -crossing.x;
    }
}
