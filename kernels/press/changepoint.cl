// Change-points of a pixel's brightness, and heights. Specification: changepoint.py.
//
// FRAME   type of a sample
// TOP     value of a saturated sample; undefined for floats
// TILE    pixels of one work-item: 1 on a GPU, many on a CPU

#pragma OPENCL FP_CONTRACT OFF
#include "common.clh"

#define INVALID -2
#define DECIDED INT_MAX

#define REACH 12
#define SLOTS (2 * REACH + 1)
#define UNIT 1048576.0f
#define STEP 4096.0f

#define STRAIGHT 0.005f
#define SPIKE 8
#define DOUBT 2
#define SPREAD 0.3f
#define SINGLE (1 / 3.0f)
#define RAMP (1 / 5.0f)
#define PLATEAU 3
#define BENT 1.5f
#define SAME_TIME 1e-4f

// Hypotheses whose misfit exceeds the least one by this many squared sigmas have negligible weight.
#define NEGLIGIBLE 40

#ifdef TOP
#define USABLE(sample) 1
#define SATURATED(sample) ((sample) == TOP)
#else
#define USABLE(sample) (fabs(sample) <= MAXFLOAT)
#define SATURATED(sample) 0
#endif

float fraction_of(const FRAME sample, const float dark, const float gain)
{
    const float fraction = ((float)sample - dark) * gain, light = gain < 0 ? 0 : 1;
    return (SATURATED(sample) & ((fraction - light) * gain < 0)) ? light : fraction;
}

int excess_of_noise(const float quiet, const float gain)
{
    return convert_int_rte(fmin(quiet * gain * gain, 1000.0f) * UNIT);
}

__kernel void changepoint_scan(
    __global const FRAME *restrict frames, const int count, const int pixels, const int first, const int level,
    const int min_excess, const float quiet, MAP dark, MAP gain, __global int *restrict start, __global int *restrict excess,
    __global int *restrict below, __global FRAME *restrict ring)
{
    const int base = get_global_id(0) * TILE;
    if (base >= pixels) return;
    const int width = min(TILE, pixels - base);

    int change[TILE], sum[TILE], alarm[TILE], dim[TILE], broken[TILE];
    float low[TILE], rate[TILE];

    int busy = 0;
    for (int p = 0; p < width; ++p) {
        change[p] = start[base + p];
        dim[p] = below[base + p];
        low[p] = dark[base + p];
        rate[p] = gain[base + p];
        alarm[p] = max(min_excess, excess_of_noise(quiet, rate[p]));
        broken[p] = change[p] == INVALID;
        sum[p] = broken[p] ? DECIDED : excess[base + p];
        busy |= !broken[p] & (sum[p] != DECIDED || first - change[p] <= REACH);
    }
    if (!busy) return;  // every pixel is decided and has its samples: nothing to read

    for (int t = 0; t < count; ++t) {
        const int number = first + t;
        __global const FRAME *restrict frame = frames + (size_t)t * pixels + base;
        __global FRAME *restrict slot = ring + (size_t)(number % SLOTS) * pixels + base;
        for (int p = 0; p < width; ++p) {
            const FRAME sample = frame[p], kept = slot[p];  // conditional loads would stay scalar
            const int undecided = sum[p] != DECIDED;
            const float fraction = fraction_of(sample, low[p], rate[p]);
            const int units = round_even((fraction < 0 ? 0 : fraction > 1 ? 1 : fraction) * UNIT);
            const int more = undecided ? sum[p] + units - level : 0;
            const int grown = more > 0 ? more : 0;
            change[p] = (undecided & (grown == 0)) ? number + 1 : change[p];
            dim[p] = (undecided & (2 * units < level)) ? number : dim[p];
            const int lasts = (grown > 0) & (number - change[p] >= REACH);
            const int certain = ((grown >= alarm[p]) | lasts) & (number > 0);
            sum[p] = (!undecided | certain) ? DECIDED : grown;

            const int taken = number - change[p] <= REACH;
            slot[p] = taken ? sample : kept;
            broken[p] |= taken & !USABLE(sample);
        }
    }

    for (int p = 0; p < width; ++p) {
        start[base + p] = broken[p] ? INVALID : change[p];
        excess[base + p] = sum[p];
        below[base + p] = dim[p];
    }
}

__kernel void changepoint_sum(
    __global const FRAME *restrict frames, const int count, const int pixels, OUT total, OUT total_rest)
{
    const int base = get_global_id(0) * TILE;
    const int end = min(pixels, base + TILE);
    for (int t = 0; t < count; ++t) {
        __global const FRAME *restrict frame = frames + (size_t)t * pixels;
        for (int p = base; p < end; ++p) {
            const Pair sum = normalised(plus((Pair){total[p], total_rest[p]}, (Pair){(float)frame[p], 0}));
            total[p] = sum.high;
            total_rest[p] = sum.rest;
        }
    }
}

__kernel void changepoint_split(
    __global const FRAME *restrict frames, const int count, const int pixels, const int first, MAP mean, MAP mean_rest,
    MAP weight, OUT total, OUT total_rest, __global int *restrict start, __global int *restrict since, OUT score,
    __global FRAME *restrict ring)
{
    const int base = get_global_id(0) * TILE;
    const int end = min(pixels, base + TILE);
    for (int t = 0; t < count; ++t) {
        const int number = first + t;
        __global const FRAME *restrict frame = frames + (size_t)t * pixels;
        __global FRAME *restrict slot = ring + (size_t)(number % SLOTS) * pixels;
        for (int p = base; p < end; ++p) {
            const FRAME sample = frame[p];
            const Pair deviation = normalised(minus((Pair){(float)sample, 0}, (Pair){mean[p], mean_rest[p]}));
            const Pair sum = normalised(plus((Pair){total[p], total_rest[p]}, deviation));
            total[p] = sum.high;
            total_rest[p] = sum.rest;

            const float explained = -sum.high * weight[number + 1];
            const int better = explained > score[p];
            since[p] = (better & (number - start[p] > REACH)) ? number : since[p];
            start[p] = better ? number + 1 : start[p];
            score[p] = better ? explained : score[p];
            slot[p] = number - start[p] <= REACH ? sample : slot[p];
        }
    }
}

// Samples around a change, as running sums in integer arithmetic: nothing is rounded.
typedef struct {
    int low, high;  // range of the available slots: [low, high)
    int values[SLOTS + 1], moments[SLOTS + 1], squares[SLOTS + 1];
} samples_t;

// A hypothesis: misfit of the samples, prior probability, time of the crossing in frames from the start, and
// its variance.
typedef struct {
    float misfit, prior, crossing, variance;
} answer_t;

typedef struct {
    float noise, level;
    int own_levels;
} query_t;

// The levels of a pixel, the level to be crossed, and its variance.
typedef struct {
    float dark, light, crossed, variance;
} levels_t;

#define IMPOSSIBLE ((answer_t){INFINITY, 1, 0, 0})

// One sample in transition between samples on the levels: the length of the ramp is not determined.
answer_t single(const samples_t *samples, const int begin, const levels_t levels, const float noise)
{
    const float above = (samples->values[begin + 1] - samples->values[begin]) / STEP - levels.dark;
    const float rise = GREATER(levels.light - levels.dark, 0.1f), fraction = LIMITED(above / rise, 0, 1);
    const float longest = 1 / GREATER(fraction, 1 - fraction);
    const float shift = longest * ((levels.crossed - levels.dark) / rise - fraction);
    const float noise_sigma = 2 / 3.0f * longest * noise / rise, missed = above - fraction * rise;
    answer_t answer;
    answer.misfit = missed * missed;
    answer.prior = SINGLE * sqrt(2 * M_PI_F) * noise;
    answer.crossing = begin - REACH + 2 / 3.0f * shift;
    answer.variance = noise_sigma * noise_sigma + shift * shift / 18;
    return answer;
}

// A straight line through the samples in transition. It should meet the levels at its ends; deviations there
// are added to the misfit. The crossing is on the line.
answer_t ramp(
    const samples_t *samples, const int begin, const int length, const levels_t levels, const float noise,
    const float enough, float *bent)
{
    const int end = begin + length, first = begin - REACH;
    const long value = samples->values[end] - samples->values[begin];
    const long moment = samples->moments[end] - samples->moments[begin];
    const long square = samples->squares[end] - samples->squares[begin];
    const long places = (long)length * (2 * first + length - 1) / 2;
    const long spread = (long)length * length * (length * length - 1) / 12;
    const long slope = length * moment - places * value;
    const long rest = (length * square - value * value) * spread - slope * slope;
    const float misfit = (float)rest / ((float)spread * length) / (STEP * STEP);
    *bent = misfit;
    if (misfit > enough || slope * 1000 <= spread * (long)STEP) return IMPOSSIBLE;

    const float duration = (float)spread / (float)slope * STEP;
    const float middle = first + 0.5f * (length - 1), mean = (float)value / (STEP * length);
    const float leaves = middle + (levels.dark - mean) * duration;
    const float arrives = middle + (levels.light - mean) * duration;
    const float early = begin > samples->low ? first - 1 - leaves : 0;
    const float late = end < samples->high ? arrives - first - length : 0;
    const float away = GREATER(GREATER(early, leaves - first), 0);
    const float back = GREATER(GREATER(late, first + length - 1 - arrives), 0);
    const float reach = 0.5f * (length + 1), off = LIMITED((levels.crossed - mean) * duration, -reach, reach);
    answer_t answer;
    answer.misfit = misfit + (away * away + back * back) / (duration * duration);
    answer.prior = RAMP * 2 * M_PI_F * noise * noise * sqrt(12.0f) * duration / length;
    answer.crossing = middle + off;
    const float apart = off * off * length / (float)spread;
    const float variance = noise * noise * (1.0f / length + apart) + levels.variance;
    answer.variance = LESSER(variance * duration * duration, reach * reach / 3);
    return answer;
}

// The samples on the dark level before each slot, and on the light level from it on: levels above dark and below
// light, and misfits, which grow with the number of samples; that of light is `square` - `fitted`.
typedef struct {
    float dark[SLOTS + 1], missing[SLOTS + 1], before[SLOTS + 1], square[SLOTS + 1], fitted[SLOTS + 1];
    float slack;
} ends_t;

ends_t ends_of(const samples_t *samples, const float noise)
{
    ends_t ends;
    const float slack = (noise / SPREAD) * (noise / SPREAD);
    ends.slack = slack;
    for (int slot = 0; slot <= SLOTS; ++slot) {  // those outside of the range are not used
        const int before = slot - samples->low, after = samples->high - slot;
        const int low_sum = samples->values[slot] - samples->values[samples->low];
        const int lack = after * (int)STEP - (samples->values[samples->high] - samples->values[slot]);
        const int low_square = samples->squares[slot] - samples->squares[samples->low];
        const int high_square = samples->squares[samples->high] - samples->squares[slot];
        const int lack_square = high_square + (int)STEP * (2 * lack - after * (int)STEP);
        ends.dark[slot] = low_sum / STEP / (before + slack);
        ends.missing[slot] = lack / STEP / (after + slack);
        ends.before[slot] = low_square / (STEP * STEP) - low_sum / STEP * ends.dark[slot];
        ends.square[slot] = lack_square / (STEP * STEP);
        ends.fitted[slot] = lack / STEP * ends.missing[slot];
    }
    return ends;
}

// The hypothesis of some samples in transition; `bent` is the misfit of a line through them.
answer_t hypothesis(
    const samples_t *samples, const query_t query, const ends_t *ends, const int begin, const int length, const float enough,
    float *bent)
{
    const int end = begin + length, before = begin - samples->low, after = samples->high - end;
    const float noise = query.noise, dark = ends->dark[begin], missing = ends->missing[end];
    const float misfit = ends->before[begin] + ends->square[end] - ends->fitted[end];
    if (misfit > enough) return IMPOSSIBLE;

    levels_t levels = {dark, 1 - missing, query.level, 0};
    if (query.own_levels) {
        const float low_part = (1 - query.level) * noise, high_part = query.level * noise;
        levels.crossed = dark + query.level * (levels.light - dark);
        levels.variance = low_part * low_part / (before + ends->slack) + high_part * high_part / (after + ends->slack);
    }
    answer_t answer = {0, 1, begin - REACH - 0.5f, 1 / 12.0f};
    if (length == 1) answer = single(samples, begin, levels, noise);
    if (length > 1) answer = ramp(samples, begin, length, levels, noise, enough - misfit, bent);
    answer.misfit += misfit;
    return answer;
}

#define LOWEST_BIT(bits) (31 - (int)clz((bits) & -(bits)))

// Mean and variance over all hypotheses by weight, and the least misfit in squared sigmas. The sums are of crossings
// relative to that of the most likely hypothesis.
float3 weigh(const samples_t *samples, const query_t query)
{
    const ends_t ends = ends_of(samples, query.noise);
    const float scale = 1 / (query.noise * query.noise);
    float best = INFINITY, enough = INFINITY, likely = 0, weight = 0, sum = 0, square = 0;
    for (int slot = samples->low + 1; slot < samples->high; ++slot)
        enough = LESSER(enough, ends.before[slot] + ends.square[slot] - ends.fitted[slot] + NEGLIGIBLE / scale);

    // The misfit of each part grows with the part. Hence the dark part ends at `last` or before, the light part
    // begins at `first` or later, and a line can fit only where both lines that are shorter by a sample fit.
    int last = samples->high, first = samples->low;
    uint fits = ~0u << samples->low;  // a bit for each first slot of a line
    for (int length = 0; length <= SLOTS; ++length) {
        while (last > samples->low && ends.before[last] > enough) --last;
        while (first < samples->high && ends.square[first] - ends.fitted[first] > enough) ++first;
        if (length > 2) fits &= fits >> 1;
        const int per_level = length < 2;  // these need a sample on each level
        const int begin_low = GREATER(samples->low + per_level, first - length);
        const int begin_high = LESSER(last, samples->high - per_level - length);
        uint candidates = begin_low > begin_high ? 0 : (fits >> begin_low << begin_low) & ((2u << begin_high) - 1);
        for (; candidates; candidates &= candidates - 1) {
            const int begin = LOWEST_BIT(candidates);
            float bent = 0;
            const answer_t answer = hypothesis(samples, query, &ends, begin, length, enough, &bent);
            if (bent > enough) fits &= ~(1u << begin);
            if (answer.misfit > enough) continue;
            const float cost = answer.misfit * scale;
            const int better = cost < best;
            // A tiny weight is 0. Otherwise the sums become denormal numbers, which are slow.
            const float apart = better ? best - cost : cost - best;
            const float lesser = apart > 2 * NEGLIGIBLE ? 0 : exponential(-0.5f * apart), kept = better ? lesser : 1;
            const float relative_weight = better ? answer.prior : answer.prior * lesser;
            const float gap = answer.crossing - likely, shift = better ? gap : 0, away = gap - shift;
            square = (square + shift * (shift * weight - 2 * sum)) * kept;
            square += relative_weight * (answer.variance + away * away);
            sum = (sum - shift * weight) * kept + relative_weight * away;
            weight = weight * kept + relative_weight;
            likely += shift;
            best = LESSER(best, cost);
            enough = LESSER(enough, (best + NEGLIGIBLE) / scale);
        }
        if (length > 1 && !(fits & ((2u << last) - 1))) break;  // no longer line can fit
    }
    const float mean = sum / weight;
    return (float3)(likely + mean, GREATER(square / weight - mean * mean, 0), best);
}

#define SAMPLE(slot) ((samples->values[(slot) + 1] - samples->values[slot]) / STEP)

// The variance of a crossing between two samples in transition if the edge is blurred by a lens, in excess of
// the noise.
float variance_of_blur(const samples_t *samples, const query_t query, const float crossing)
{
    const float level = query.level;
    const int nearest = round_even(crossing), later = SAMPLE(LIMITED(nearest + REACH, 0, SLOTS - 1)) >= level;
    const int at_sample = LESSER(crossing - nearest, nearest - crossing) > -SAME_TIME;
    const int frame = at_sample ? nearest - later : (int)floor(crossing), slot = frame + REACH;
    if (slot < samples->low || slot + 1 >= samples->high) return 0;
    const float low = SAMPLE(slot), high = SAMPLE(slot + 1);
    const float margin = PLATEAU * query.noise;
    if (low < margin || low >= level || high < level || high > 1 - margin) return 0;
    // The quantile of a share is proportional to v + BENT v^3, with v = share - 1/2.
    const float first = low - 0.5f, second = high - 0.5f, middle = level - 0.5f, rise = high - low;
    const float both = first * first + first * second + second * second, fraction = (level - low) / rise;
    const float bent = fraction * (1 + BENT * (middle * middle + middle * first + first * first)) / (1 + BENT * both);
    const float off = frame + bent - crossing, noise_sigma = query.noise / rise;
    return GREATER(off * off - noise_sigma * noise_sigma * (fraction * fraction + (1 - fraction) * (1 - fraction)), 0.0f);
}

// The same without the misfit, and with a variance that includes it and the blur.
float2 estimate(const samples_t *samples, query_t query)
{
    const float3 posterior = weigh(samples, query);
    const int freedom = max(samples->high - samples->low - 4, 1);
    const float blur = variance_of_blur(samples, query, posterior.x);
    if (posterior.z <= DOUBT * freedom) return (float2)(posterior.x, posterior.y + blur);
    // Samples that no hypothesis fits are noisier than stated, or change in another way.
    query.noise *= sqrt(posterior.z / freedom);
    const float3 again = weigh(samples, query);
    const float moved = again.x - posterior.x;
    return (float2)(posterior.x, again.y + moved * moved + blur);
}

void gather(
    samples_t *samples, const int pixel, const int pixels, const int count, const int start, const int since,
    const float dark, const float gain, const float noise, __global const FRAME *restrict ring)
{
    samples->low = max(since, start - REACH) - (start - REACH);
    samples->high = min(count, start + REACH + 1) - (start - REACH);
    int values[SLOTS];
    for (int i = samples->low; i < samples->high; ++i) {
        const int number = start - REACH + i;
        const float fraction = fraction_of(ring[(size_t)(number % SLOTS) * pixels + pixel], dark, gain);
        values[i] = round_even(LIMITED(fraction, -1, 2) * STEP);
    }
    const int limit = round_even(SPIKE * LESSER(noise, 100) * STEP);
    samples->values[0] = samples->moments[0] = samples->squares[0] = 0;
    for (int i = 0; i < SLOTS; ++i) {
        int value = i >= samples->low && i < samples->high ? values[i] : 0;
        if (i > samples->low && i < samples->high - 1) {
            const int low = LESSER(values[i - 1], values[i + 1]), high = GREATER(values[i - 1], values[i + 1]);
            value = value > high + limit ? high : value < low - limit ? low : value;
        }
        samples->values[i + 1] = samples->values[i] + value;
        samples->moments[i + 1] = samples->moments[i] + (i - REACH) * value;
        samples->squares[i + 1] = samples->squares[i] + value * value;
    }
}

// Whether the samples do not rise significantly at the change.
int is_flat(const samples_t *samples, const float noise)
{
    const int before = REACH - samples->low, after = samples->high - REACH;
    const float dark = (samples->values[REACH] - samples->values[samples->low]) / STEP / before;
    const float light = (samples->values[samples->high] - samples->values[REACH]) / STEP / after;
    return light - dark < 6 * noise * sqrt(1.0f / before + 1.0f / after);
}

// Travel between frames, extrapolated beyond the ends, as the sum of two floats; the frame is relative to the
// start, which preserves its last bits.
float2 travel_at(__global const float2 *restrict travel, const int count, const int start, const float crossing)
{
    const int frame = clamp(start + (int)floor(crossing), 0, count - 2);
    const float2 step = travel[frame + 1] - travel[frame];
    const float fraction = crossing - (frame - start);
    return (float2)(travel[frame].x, travel[frame].y + fraction * (step.x + step.y));
}

__kernel void changepoint_heights(
    const int pixels, const int count, __global const int *restrict start, __global const int *restrict excess,
    __global const int *restrict below, __global const int *restrict since, MAP dark, MAP gain,
    __global const FRAME *restrict ring, __global const float2 *restrict travel, const float noise, const float quiet,
    const float level, const int own_levels, OUT height, OUT sigma, __global uchar *restrict status)
{
    const int base = get_global_id(0) * TILE;
    const int end = min(pixels, base + TILE);
    for (int p = base; p < end; ++p) {
        const int never = excess[p] <= excess_of_noise(quiet, gain[p]);
        height[p] = NAN;
        sigma[p] = NAN;
        status[p] = start[p] == INVALID ? 0 : never ? 2 : start[p] == 0 ? 3 : 1;
        if (status[p] != 1) continue;

        const float spread = GREATER(noise * fabs(gain[p]), STRAIGHT);
        samples_t samples;
        gather(&samples, p, pixels, count, start[p], since[p], dark[p], gain[p], spread, ring);
        const float dim = start[p] - below[p];
        const int hovered = dim > REACH && is_flat(&samples, spread);
        const float2 crossing = hovered ? (float2)(-dim / 2, dim * dim / 12)
                                        : estimate(&samples, (query_t){spread, level, own_levels});
        const float middle = LIMITED(crossing.x, (float)-start[p], (float)(count - 1 - start[p]));
        const float deviation = sqrt(crossing.y);
        const float2 at = travel_at(travel, count, start[p], middle);
        const float2 late = travel_at(travel, count, start[p], middle + deviation);
        const float2 early = travel_at(travel, count, start[p], middle - deviation);
        height[p] = -(at.x + at.y);
        sigma[p] = 0.5f * fabs((late.x - early.x) + (late.y - early.y));
    }
}
