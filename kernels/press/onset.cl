// Onset of the light state: the first crossing of the threshold that is confirmed. Specification: onset.py.
//
// FRAME    type of a sample; BITS, its width
// TILE     pixels of one work-item: 1 on a GPU, many on a CPU
// RELEASE  1: samples are complemented, which exchanges dark and light, to find the end of the light state
// SUBFRAME 0: the height is that of the paper's equation 4, at the frame of the onset itself
// ALIKE    1: numbers for all pixels take the place of `levels` and `thresholds`
//
// A map is a plane of `stride` pixels; only the first `pixels` are in the picture:
//
// levels       counts at which a pixel turns light, NaN if it cannot; counts of its dark plateau
// thresholds   the smallest light sample; the smallest that is not certainly dark; the smallest near the level
// frames_left  number of frames after which a pixel is decided if all are light, at most MOST
// times        frame at which the run started, -1 without one; the last certainly dark frame and the last frame not
//              near the level, before an incomplete run, or before now if the last sample is near the level
// samples      the last sample; those before, at and after the onset of an incomplete run; the sample after the last
//              one that was not near the level
// answers      height; sigma: as if no frame followed
// status       0 invalid input, 1 onset, 2 never light, 3 light at start (RELEASE: 2 dark at start, 3 light to the
//              end)
// travel       has three numbers of each frame: travel; the step to it; travel since the first frame

#pragma OPENCL FP_CONTRACT OFF
#include "common.clh"

#define DARK -1  // also of a pixel with invalid input, which is decided: `frames_left` is 0
#define BENT 1.5f  // onset.py
#define NEAR_PLATEAU 0.06f  // onset.py
#define CLEAR_RISE 34  // standard deviations: a quarter of it is 8.5, which noise does not reach

// As wide as a sample, so that both have vectors of the same length.
#if BITS == 8
typedef uchar Count;
#elif BITS == 16
typedef ushort Count;
#else
typedef uint Count;
#endif
#define CHUNK (TILE < 256 ? TILE : 256)  // most pixels examined together when something happens
#define SINGLE (TILE < 16 ? TILE : 16)  // the same for a frame on its own, in which less happens
#define MOST (BITS == 8 ? 255 : 65535)
#define NONE ((Count)~0u)
#define SPAN 64  // frames that are counted before anything else is examined
#define NEVER (2 + RELEASE)  // status without an onset

#if ALIKE
#define LEVELS const float level_of_all, const float plateau_of_all, const FRAME light_of_all, \
    const FRAME dark_limit_of_all, const FRAME near_limit_of_all
#define LEVEL(p) level_of_all
#define PLATEAU(p) plateau_of_all
#define LIGHT(p) light_of_all
#define DARK_LIMIT(p) dark_limit_of_all
#define NEAR_LIMIT(p) near_limit_of_all
#else
#define LEVELS MAP levels, __global const FRAME *restrict thresholds
#define LEVEL(p) levels[base + (p)]
#define PLATEAU(p) levels[stride + base + (p)]
#define LIGHT(p) light[p]
#define DARK_LIMIT(p) thresholds[stride + base + (p)]
#define NEAR_LIMIT(p) thresholds[2 * stride + base + (p)]
#endif

#if BITS == 32
#define SEE(x) (RELEASE ? -(x) : (x))
#define BROKEN(x) ((as_uint(x) & 0x7f800000u) == 0x7f800000u)
#define LEAST(a, b) ((a) < (b) || (b) != (b) ? (a) : (b))
#else
#define SEE(x) ((FRAME)(RELEASE ? ~(x) : (x)))
#define BROKEN(x) 0
#define LEAST(a, b) LESSER(a, b)
#endif

// --- Light samples ------------------------------------------------------------------------------------------------

float next_up(const float x)
{
    const int bits = as_int(x), up = bits + (bits < 0 ? -1 : 1);
    return as_float(x == 0 ? 1 : up);
}

// The smallest float not below dark + fraction (bright - dark), as if in double precision.
float level_between(const float dark, const float bright, const float fraction, const float fraction_rest)
{
    const Pair range = sum_of(bright, -dark), product = product_of(fraction, range.high);
    const Pair sum = sum_of(dark, product.high);
    const float rest = product.rest + (fraction * range.rest + fraction_rest * range.high);
    const Pair level = sum_of(sum.high, sum.rest + rest);
    return level.rest > 0 ? next_up(level.high) : level.high;
}

// Converts bright and dark, maps of step 1 or single numbers of step 0, to level and dark, and computes the
// smallest light sample.
__kernel void onset_levels(
    const int pixels, const int stride, const float fraction, const float fraction_rest, MAP brights,
    const int bright_step, MAP darks, const int dark_step, OUT levels, __global FRAME *restrict thresholds)
{
    const int base = get_global_id(0) * TILE, width = min(TILE, pixels - base);
    const int different = bright_step | dark_step ? width : 1;  // pixels; the others equal the first
    if (width <= 0) return;
    // Compilers do not vectorise unknown strides, nor (Intel's) stores to two planes of one array.
    float high[TILE], low[TILE];
    for (int p = 0; p < different; ++p) high[p] = brights[bright_step ? base + p : 0];
    for (int p = 0; p < different; ++p) low[p] = darks[dark_step ? base + p : 0];
    for (int p = 0; p < different; ++p) {
        const float bright = high[p], dark = low[p], range = bright - dark;
        const int usable = (range > 0) & (range - range == 0);  // the last condition: finite
        const float between = level_between(dark, bright, fraction, fraction_rest), level = usable ? between : NAN;
#if BITS == 32
        thresholds[base + p] = RELEASE ? next_up(-level) : level;
        levels[base + p] = RELEASE ? -level : level;
        low[p] = RELEASE ? -bright : dark;
#else
        // Rounded up; a saturated sample is light. A pixel that is never dark has no release.
        const float top = NONE, bound = level > 0 ? (level < top ? level : top) : usable ? 0 : top;
        const int whole = (int)bound, reached = whole + (whole < bound);
        thresholds[base + p] = RELEASE ? (FRAME)(NONE - reached + 1) : (FRAME)reached;
        levels[base + p] = RELEASE ? (reached > 0 ? top - level : NAN) : level;
        low[p] = RELEASE ? top - bright : dark;
#endif
    }
    const FRAME first_threshold = thresholds[base];
    const float level = levels[base], dark = low[0];
    for (int p = different; p < width; ++p) thresholds[base + p] = first_threshold;
    for (int p = different; p < width; ++p) levels[base + p] = level;
    for (int p = 0; p < different; ++p) levels[stride + base + p] = low[p];
    for (int p = different; p < width; ++p) levels[stride + base + p] = dark;
}

// Computes the smallest samples that are not certainly dark (within `tolerance` counts of the level) and that
// are near the level (within a quarter of the rise from dark).
__kernel void onset_sure(
    const int pixels, const int stride, const float tolerance, MAP levels, __global FRAME *restrict thresholds)
{
    const int base = get_global_id(0) * TILE, width = min(TILE, pixels - base);
    FRAME dark_limits[TILE], near_limits[TILE];
    for (int p = 0; p < width; ++p) {
        const float level = levels[base + p], dark_limit = level - tolerance;
        const FRAME light = thresholds[base + p];
#if BITS == 32
        const FRAME above = next_up(dark_limit);
#else
        const float bound = dark_limit < NONE ? (dark_limit < -1 ? -1 : dark_limit) : NONE - 1;
        const FRAME above = level < 0 ? light : (FRAME)((int)(bound + 1));
#endif
        const FRAME dim = LESSER(above, light);
        const float near_rise = 0.25f * (level - levels[stride + base + p]);
        const float near_limit = level - (near_rise > 0 ? near_rise : 0);
        dark_limits[p] = dim;
#if BITS == 32
        near_limits[p] = LESSER(near_limit, dim);
#else
        const float bounded = near_limit > 0 ? (near_limit < NONE ? near_limit : NONE) : 0;
        const int whole = (int)bounded, reached = whole + (whole < bounded);
        near_limits[p] = LESSER(reached, dim);
#endif
    }
    for (int p = 0; p < width; ++p) thresholds[stride + base + p] = dark_limits[p];
    for (int p = 0; p < width; ++p) thresholds[2 * stride + base + p] = near_limits[p];
}

// --- Samples around an onset --------------------------------------------------------------------------------------

// The last frame below `bound`, from frame `from` of a pixel's `series` backwards; the very first counts as
// dark. The series starts with frame `first`; `last` is the sample before it, and `previous` the result there.
int last_below(
    __global const FRAME *series, const int from, const int pixels, const int first, const FRAME bound,
    const FRAME last, const int previous)
{
    for (int k = from; k >= first && k > 0; --k)
        if (SEE(series[(size_t)(k - first) * pixels]) < bound) return k;
    return first == 0 ? 0 : last < bound ? first - 1 : previous;
}

// Height and variance of a pixel, see onset.py. Everything is computed and then selected, so that it
// vectorises. `jumped` means that `from` and `step` describe the step in which the pixel rose to its plateau,
// not the onset. Compilers do not inline a function of this size, nor vectorise a loop that calls one.
__attribute__((always_inline)) float2 answer(
    const float low, const float high, const float after, const float waited, const float unclear_travel,
    const float from, const float step, const float level, const float dark, const float threshold, const float noise,
    const float dark_tolerance, const float light_tolerance, const int jumped)
{
    const float rise = high - low, steepness = 1 / rise;
    const int waits = (rise <= light_tolerance) | ((waited - 2) * rise > 2.5f * light_tolerance);
    const int hovered = waits & !jumped;
    const float dark_range = GREATER(dark_tolerance, NEAR_PLATEAU * rise), light_range = GREATER(light_tolerance, NEAR_PLATEAU * rise);
    const float from_dark = LIMITED(2 - (low - dark) / dark_range, 0, 1);
    const float to_light = LIMITED(2 - (after - high) / light_range, 0, 1), both_plateaus = from_dark * to_light;
    const float sudden = jumped ? 1 : both_plateaus;
    const float raised = level > low ? level : low, clamped = raised < high ? raised : high;
    const float crossed = (clamped - low) * steepness, rest = 1 - crossed, fraction = crossed + sudden * (0.5f - crossed);
    const float slope = step * noise * steepness, width = step + unclear_travel;
    // With the quantile of a normal distribution in place of the fraction: v + BENT v^3, v = fraction - 1/2.
    const float to_level = level - dark, per_count = to_level > 0 ? threshold / to_level : 0, middle = threshold - 0.5f;
    const float below = (low - dark) * per_count - 0.5f, above = (high - dark) * per_count - 0.5f;
    const float both = below * below + below * above + above * above;
    const float off = step * crossed * BENT * (middle - above) * (middle + below + above) / (1 + BENT * both);
    const float from_edge = slope * slope * (crossed * crossed + rest * rest) + off * off;
    const float on_plateau = from_dark * rest * rest + to_light * crossed * crossed;
    const float from_shape = step * step * (on_plateau - both_plateaus * (rest * rest + crossed * crossed)) / 6;
    const float known = (1 - sudden) * from_edge + (jumped ? 0 : from_shape) + sudden * step * step / 12;
    return (float2)(-(from + step * fraction), hovered ? width * width / 12 : known);
}

// --- Frame by frame -----------------------------------------------------------------------------------------------

// Finds the last frames, up to `from`, that were certainly dark and that were not near the level, and the
// sample after the latter.
#define LOOK_BACK(p, from) \
    { \
        const FRAME last = first > 0 ? SEE(lasts[p]) : 0; \
        darks[p] = last_below(frames + (p), from, pixels, first, DARK_LIMIT(p), last, darks[p]); \
        last_fars[p] = last_below(frames + (p), darks[p], pixels, first, NEAR_LIMIT(p), last, last_fars[p]); \
        const int next = last_fars[p] + 1 - first; \
        if (next >= 0 && next <= from - first) first_rises[p] = SEE(frames[(size_t)next * pixels + (p)]); \
    }

#define LACK(a, b) ((a) > (b) ? (a) - (b) : 0)

// One of several frames processed together: where it is dark, the run of the pixel restarts, unless it is
// confirmed. Both conditions hold where neither difference is 0: many processors cannot compare unsigned
// bytes, but have saturated differences.
#if BITS == 32
#define TAKE(i) \
    sample = SEE(group[(size_t)(i) * pixels + p]); \
    again = (end_of_run > clock##i) & (sample < LIGHT(p)); \
    bad[p] |= (end_of_run > clock##i) & BROKEN(sample); \
    end_of_run = again ? next##i : end_of_run;
#else
#define TAKE(i) \
    sample = SEE(group[(size_t)(i) * pixels + p]); \
    again = LESSER((Count)LACK(LIGHT(p), sample), (Count)LACK(end_of_run, clock##i)); \
    end_of_run = again ? next##i : end_of_run;
#endif
// Read from an array: compilers widen computed values to 32 bits.
#define TIMES(i) const Count clock##i = CLOCK(t + i), next##i = CLOCK(t + i + 1) + unconfirmed;
#if TILE > 1
#define CLOCK(t) clock[t]
#else
#define CLOCK(t) (Count)(t)
#endif
#define PIXELS(take) \
    for (int p = 0; p < width; ++p) { \
        FRAME sample; \
        Count again; \
        Count end_of_run = held[p]; \
        take \
        held[p] = end_of_run; \
    }

#define EIGHT(each) each(0) each(1) each(2) each(3) each(4) each(5) each(6) each(7)
#define SIXTEEN(each) EIGHT(each) each(8) each(9) each(10) each(11) each(12) each(13) each(14) each(15)

// Processes frames `first` to `first + count` of a press. Without SUBFRAME there are no `samples`.
__kernel void onset_scan(
    __global const FRAME *restrict frames, const int count, const int pixels, const int stride, const int first,
    const int hold, const float threshold, LEVELS, __global Count *restrict frames_left,
    __global int *restrict times, MAP travel,
    const float noise, const float dark_tolerance, const float light_tolerance, __global FRAME *restrict samples,
    OUT answers, __global uchar *restrict status)
{
    const int base = get_global_id(0) * TILE, width = min(TILE, pixels - base);
    // Frames after an onset until it is final.
    const int needed = SUBFRAME && hold < 3 ? 3 : hold;
    const Count after = needed - hold;
    const Count whole = LESSER(needed, MOST);
    // counted frames of a run: beyond this it cannot be confirmed within SPAN
    const Count unconfirmed = LESSER(hold, 2 * SPAN);
    const int chunk = count > 1 ? CHUNK : SINGLE;
#if TILE > 1
    Count clock[SPAN + 1];
    for (int t = 0; t <= SPAN; ++t) clock[t] = t;
#endif
#if !ALIKE
    FRAME light[TILE];
    for (int p = 0; p < width; ++p) light[p] = thresholds[base + p];
#endif
    Count remain[TILE];
    if (first > 0)
        for (int p = 0; p < width; ++p) remain[p] = frames_left[base + p];
    else {
        for (int p = 0; p < width; ++p) {
            const float level = LEVEL(p);
            const int usable = level == level;
            remain[p] = usable ? whole : 0;
            status[base + p] = usable ? NEVER : 0;
        }
        for (int p = 0; p < width; ++p) times[base + p] = DARK;
        for (int p = 0; p < width; ++p) answers[base + p] = NAN;
        for (int p = 0; p < width; ++p) answers[stride + base + p] = NAN;
    }
    frames += base;
    times += base;
    answers += base;
    status += base;
    __global int *restrict darks = times + stride, *restrict last_fars = darks + stride;
    __global FRAME *restrict lasts = samples + base, *restrict lows = lasts + stride, *restrict highs = lows + stride,
                   *restrict laters = highs + stride, *restrict first_rises = laters + stride;
    if (first == 0 && SUBFRAME)
        for (int p = 0; p < width; ++p) darks[p] = last_fars[p] = 0;
    if (first < 2 && first + count > 1 && SUBFRAME)
        for (int p = 0; p < width; ++p) first_rises[p] = SEE(frames[(size_t)(1 - first) * pixels + p]);

    for (int start = 0; start < count; start += SPAN) {
        const int now = first + start, length = min(SPAN, count - start), end = now + length;
        __global const FRAME *restrict span = frames + (size_t)start * pixels;
        Count any = 0;
        for (int p = 0; p < width; ++p) any |= remain[p];
        if (!any) break;

        // When a run is confirmed, counted from `now`, if all frames from its start are light; beyond `unconfirmed`
        // if it starts after `now`.
        Count held[TILE], bad[TILE];
        const Count dark = length + unconfirmed;  // if the last frame is dark
        for (int p = 0; p < width; ++p) held[p] = LESSER((Count)LACK(remain[p], after), unconfirmed);
        for (int p = 0; p < width; ++p) bad[p] = 0;
        for (int t = 0; t < length;) {
            __global const FRAME *restrict group = span + (size_t)t * pixels;
            if (t + 16 <= length) {
                SIXTEEN(TIMES)
                PIXELS(SIXTEEN(TAKE))
                t += 16;
            } else if (t + 8 <= length) {
                EIGHT(TIMES)
                PIXELS(EIGHT(TAKE))
                t += 8;
            } else {
                TIMES(0)
                PIXELS(TAKE(0))
                t += 1;
            }
        }

        // Chunks in which nothing happens are skipped as a whole.
        for (int low = 0, high; low < width; low = high) {
            high = LESSER(low + (low % CHUNK ? chunk : CHUNK), width);
            Count changed = needed > MOST, before[CHUNK];
            for (int p = low; p < high; ++p)
                changed |= (remain[p] > 0 ? (held[p] ^ dark) | (remain[p] ^ whole) : 0) | bad[p];
            if (!changed) continue;
            high = LESSER(low + chunk, width);

            for (int p = low; p < high; ++p) {
                const int start_of_run = times[p], unbroken = start_of_run >= 0 ? start_of_run : now;
                const int broken = bad[p], began = held[p] - unconfirmed;
                const int run = began <= 0 ? unbroken : began == length ? DARK : now + began;
                const int begin = remain[p] == 0 ? start_of_run : broken ? DARK : run, rest = needed - (end - begin);
                const int lacks = remain[p] == 0 || broken ? 0 : begin == DARK ? needed : rest < 0 ? 0 : rest;
                before[p - low] = remain[p];
                times[p] = begin;
                remain[p] = lacks < MOST ? lacks : MOST;
            }
            if (!SUBFRAME) {
                for (int p = low; p < high; ++p) {
                    const int begin = times[p], frame = begin < 1 ? 1 : begin;
                    const float height = -travel[3 * frame], step = travel[3 * frame + 1], size = step < 0 ? -step : step;
                    answers[p] = begin > 0 ? height : NAN;
                    answers[stride + p] = begin > 0 ? size * 0.577350269f : NAN;  // over sqrt(3)
                    status[p] = begin > 0 ? 1 : begin == 0 ? 3 - RELEASE : remain[p] > 0 ? NEVER : 0;
                }
                continue;
            }

            // The samples around onsets within these frames. Those of other pixels are meaningless: simple
            // loops over all are faster than a selection.
            FRAME dim[CHUNK], bright[CHUNK], later[CHUNK], second[CHUNK];
            int at[CHUNK], old = 0, running = 0, unsure = 0;
            for (int p = low; p < high; ++p) {
                const int looked_at = (before[p - low] > 0) & (times[p] > 0), t = times[p] - now;
                old |= looked_at & (t < 0);
                running |= looked_at & (remain[p] > 0);
                at[p - low] = t > 0 ? t : 0;
            }
            for (int p = low, i = 0; p < high; ++p, ++i) bright[i] = span[(long)at[i] * pixels + p];
            for (int p = low, i = 0; p < high; ++p, ++i) dim[i] = span[(long)(at[i] - (start + at[i] > 0)) * pixels + p];
            for (int p = low, i = 0; p < high; ++p, ++i) later[i] = span[(long)LESSER(at[i] + 1, length - 1) * pixels + p];
            for (int p = low, i = 0; p < high; ++p, ++i) second[i] = span[(long)LESSER(at[i] + 2, length - 1) * pixels + p];
            for (int p = low, i = 0; p < high; ++p, ++i) {
                const FRAME one = SEE(later[i]), two = SEE(second[i]), last = lasts[p], sample = dim[i];
                bright[i] = SEE(bright[i]);
                dim[i] = start + at[i] > 0 ? SEE(sample) : SEE(last);
                later[i] = LEAST(one, two);
            }
            // Runs that started before `now` use the samples that were kept, and the next two.
            for (int p = low; p < high && old; ++p) {
                if ((before[p - low] == 0) | (times[p] <= 0) | (times[p] >= now)) continue;
                const FRAME kept = laters[p], one = SEE(span[p]), two = SEE(span[length > 1 ? p + pixels : p]);
                const int since = now - times[p];
                dim[p - low] = lows[p];
                bright[p - low] = highs[p];
                later[p - low] = since == 1 ? LEAST(one, two) : since == 2 ? LEAST(kept, one) : kept;
            }

            // If the previous sample is near the level, the search continues backwards, mostly by one sample.
            float waited[CHUNK], unclear_travel[CHUNK];
            int frame[CHUNK], jumped[CHUNK], waits[CHUNK], hard = 0;
            for (int p = low; p < high; ++p) {
                waited[p - low] = 1;
                unclear_travel[p - low] = 0;
                frame[p - low] = times[p] < 1 ? 1 : times[p];
                jumped[p - low] = 0;
                waits[p - low] = (before[p - low] > 0) & (times[p] > 0) & !(dim[p - low] < NEAR_LIMIT(p));
                unsure |= waits[p - low];
            }
            if (unsure) {
                int looks[CHUNK];
                for (int p = low, i = 0; p < high; ++p, ++i) second[i] = span[(long)(start + at[i] > 1 ? at[i] - 2 : 0) * pixels + p];
                for (int p = low, i = 0; p < high; ++p, ++i) {
                    const FRAME sample = dim[i], earlier = SEE(second[i]), first_rise = first_rises[p];
                    const FRAME dark_limit = DARK_LIMIT(p), near_limit = NEAR_LIMIT(p);
                    const int begin = times[p], dark = darks[p], last_far = last_fars[p];
                    const int new = waits[i] & (begin >= now);
                    const int next = new & (start + at[i] > 1) & (earlier < near_limit);
                    const int dimmed = begin - 2 + (sample < dark_limit);
                    darks[p] = next ? dimmed : dark;
                    last_fars[p] = next ? begin - 2 : last_far;
                    first_rises[p] = next ? sample : first_rise;
                    looks[i] = new & !next;
                    hard |= looks[i];
                }
                for (int p = low; p < high && hard; ++p)
                    if (looks[p - low]) LOOK_BACK(p, times[p] - 1)
                for (int p = low, i = 0; p < high; ++p, ++i) {
                    const int begin = times[p], kept = waits[i], from = kept ? begin - 1 : 0, dark = kept ? darks[p] : 0;
                    waited[i] = kept ? begin - dark : 1;
                    unclear_travel[i] = travel[3 * from + 2] - travel[3 * dark + 2];
                    const float to_level = LEVEL(p) - PLATEAU(p);
                    const float light = later[i], first_rise = first_rises[p];
                    const int rises = first_rise >= light - to_level * 0.125f;
                    jumped[i] = kept & rises & (last_fars[p] + 1 < begin) & (to_level >= CLEAR_RISE * noise);
                    frame[i] = jumped[i] ? last_fars[p] + 1 : frame[i];
                }
            }

            float sigma[CHUNK];
            for (int p = low; p < high; ++p) sigma[p - low] = answers[stride + p];
            for (int p = low, i = 0; p < high; ++p, ++i) {
                const int begin = times[p];
                const float2 crossing = answer(dim[i], bright[i], later[i], waited[i], unclear_travel[i],
                                               travel[3 * (frame[i] - 1)], travel[3 * frame[i] + 1], LEVEL(p),
                                               PLATEAU(p), threshold, noise, dark_tolerance,
                                               light_tolerance, jumped[i]);
                const float height = answers[p], spread = rough_inverse_root(crossing.y);
                const uchar was = status[p], is = begin > 0 ? 1 : begin == 0 ? 3 - RELEASE : remain[p] > 0 ? NEVER : 0;
                answers[p] = before[i] == 0 ? height : begin > 0 ? crossing.x : NAN;
                sigma[i] = before[i] == 0 ? sigma[i] : begin > 0 ? crossing.y * spread : NAN;
                status[p] = before[i] == 0 ? was : is;
            }
            for (int p = low; p < high; ++p) answers[stride + p] = sigma[p - low];
            for (int p = low; p < high && running; ++p) {
                const int begin = times[p], dark = darks[p], last_far = last_fars[p];
                const FRAME first_rise = first_rises[p];
                const int rises = (begin > 0) & (dim[p - low] < NEAR_LIMIT(p));
                lows[p] = dim[p - low];
                highs[p] = bright[p - low];
                laters[p] = later[p - low];
                darks[p] = ((begin > 0) & (dim[p - low] < DARK_LIMIT(p))) ? begin - 1 : dark;
                last_fars[p] = rises ? begin - 1 : last_far;
                first_rises[p] = rises ? bright[p - low] : first_rise;
            }
        }
    }

    for (int p = 0; p < width; ++p) frames_left[base + p] = remain[p];
    if (!SUBFRAME) return;
    // If the last sample is near the level, the next block cannot determine how long it has been.
    __global const FRAME *restrict final = frames + (size_t)(count - 1) * pixels;
    for (int low = 0, high; low < width; low = high) {
        high = LESSER(low + (low % CHUNK ? chunk : CHUNK), width);
        Count unsure = 0;
        for (int p = low; p < high; ++p) unsure |= (remain[p] == whole) & !(SEE(final[p]) < NEAR_LIMIT(p));
        if (!unsure) continue;
        high = LESSER(low + chunk, width);
        for (int p = low; p < high; ++p)
            if (times[p] == DARK && SEE(final[p]) >= NEAR_LIMIT(p)) LOOK_BACK(p, first + count - 1)
    }
    for (int p = 0; p < width; ++p) lasts[p] = final[p];
}
