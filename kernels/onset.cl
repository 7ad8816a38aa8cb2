// Onset of the light state: the first crossing of the threshold that holds. Specification: onset.py.
//
// Samples are compared side by side in a word, and the answers of up to SPAN frames packed into one integer a pixel:
// where a run of light frames holds is then bit arithmetic. Only words in which something happens are looked at
// pixel by pixel, while their frames are still in the cache.
//
// FRAME    type of a sample; BITS, its width
// LANES    32-bit lanes of a word: 16 where an item is a core's loop, 4 where it is one of many side by side
// WORDS    words of one work-item
// HOLD     light frames in a row that make an onset
// SAMPLES  1 to look between the frames, 0 for the frame of the onset alone
// RELEASE  1 to look for the end of the light state: each sample is complemented, so dark is light and light is dark
// ALIGNED  1 where every frame begins at a multiple of a word
//
// Maps lie in planes of `stride` pixels, whole words, of which the first `pixels` are the picture's:
//
// levels   counts at which a pixel turns light, NaN where it cannot; counts of its dark plateau
// marks    the smallest sample that is light; the smallest that is not surely dark
// closed   all bits of a pixel set once its onset is decided; the same for pixels that never get one
// busy     of each word: whether a run is open, or the samples around it are not complete
// times    frame at which the run began; the last surely dark frame before a run that is not complete, or before now
//          where the last sample is not surely dark
// samples  the last sample; those before, at and after the onset of a run that is not complete
// answers  height; sigma
// status   0 invalid input, 1 onset, 2 never light, 3 light at start (RELEASE: 2 dark at start, 3 light to the end)
// travel   has planes of `room` frames: travel; the step to it; travel since the first frame

#pragma OPENCL FP_CONTRACT OFF
#include "common.clh"

#define DARK -1
#define INVALID -2

#define SPAN 32   // frames whose answers fit into one integer
#define GROUP 8   // frames that are compared at once
#define NEEDED (!SAMPLES || HOLD > 3 ? HOLD : 3)  // frames from an onset on, after which nothing about it can change

typedef JOIN(uint, LANES) Word;

#define PLANES (SPAN / BITS)
#define PIXELS (32 / BITS * LANES)  // of a word
#if BITS == 8
typedef uchar Bits;
#define TOP 0x80808080u  // the highest bit of each sample in a lane
#elif BITS == 16
typedef ushort Bits;
#define TOP 0x80008000u
#else
typedef uint Bits;
#define TOP 0x80000000u
#endif
#define ALL ((Bits)~0u)

typedef union {
    Word word;
    Bits pixel[PIXELS];
} Flags;

#if ALIGNED
#define LOAD(frame, w) (((__global const Word *)(frame))[w])
#else
typedef struct __attribute__((packed)) { Word word; } Stored;
#define LOAD(frame, w) (((__global const Stored *)(frame))[w].word)
#endif

// Macros where functions would be nicer: PoCL passes 64-byte vectors to functions wrongly on some processors.
#if BITS == 32
#define COMPLEMENT(x) (-(x))
#define COMPLEMENTS(x) ((x) ^ TOP)
#define AT_LEAST(x, y) JOIN(as_uint, LANES)(JOIN(as_float, LANES)(x) >= JOIN(as_float, LANES)(y))
#define BROKEN(x) (((x) & ~TOP) + 0x00800000u)  // carries into TOP where the exponent says NaN or infinite
#define LEAST(a, b) fmin(a, b)
#else
#define COMPLEMENT(x) ((FRAME)~(x))
#define COMPLEMENTS(x) (~(x))
// TOP is set where x >= y: by the highest bits where they differ, else by the difference of the others.
#define AT_LEAST(x, y) (((x) & ~(y)) | (~((x) ^ (y)) & (((x) | TOP) - ((y) & ~TOP))))
#define LEAST(a, b) LESSER(a, b)
#endif
#if RELEASE
#define SEE(x) COMPLEMENT(x)
#define SEE_WORD(x) COMPLEMENTS(x)
#define FROM_START 2
#define NEVER 3
#else
#define SEE(x) (x)
#define SEE_WORD(x) (x)
#define FROM_START 3
#define NEVER 2
#endif

int any4(const uint4 flags)
{
    const uint2 pair = flags.lo | flags.hi;
    return (pair.x | pair.y) != 0;
}

#if LANES == 16
#define ANY(flags) any4(((flags).lo | (flags).hi).lo | ((flags).lo | (flags).hi).hi)
#else
#define ANY(flags) any4(flags)
#endif

// Exponents of floats, because the compiler makes vector code of these and not of clz.
int lowest_bit(const uint bits) { return (int)(as_uint((float)(int)(bits & -bits)) >> 23 & 0xff) - 127; }

// Of 31 bits; -1 without any. No neighbour below the highest, so it is not rounded up to the next power of two.
int highest_bit(const uint bits) { return (int)(as_uint((float)(int)(bits & ~(bits >> 1)) + 0.5f) >> 23) - 127; }

// OpenCL's prefetch does nothing in PoCL. Where an item is a core's loop, addresses are the same in all address spaces.
#if LANES == 16 && defined(__has_builtin)
#if __has_builtin(__builtin_prefetch)
#define FETCH(sample) __builtin_prefetch((const void *)(size_t)(sample), 0, 2)
#endif
#endif
#ifndef FETCH
#define FETCH(sample)
#endif

// --- Which samples are light -----------------------------------------------------------------------------------

float next_up(const float x)
{
    const int bits = as_int(x), up = bits + (bits < 0 ? -1 : 1);
    return as_float(x == 0 ? 1 : up);
}

// The smallest float that is not below dark + share (bright - dark), as if in double precision.
float level_between(const float dark, const float bright, const float share, const float share_rest)
{
    const Pair range = sum_of(bright, -dark), product = product_of(share, range.high), sum = sum_of(dark, product.high);
    const Pair level = sum_of(sum.high, sum.rest + (product.rest + (share * range.rest + share_rest * range.high)));
    return level.rest > 0 ? next_up(level.high) : level.high;
}

// Turns bright and dark, in the planes of `levels`, into level and dark, and finds what is light.
__kernel void onset_levels(
    const int pixels, const int stride, const float share, const float share_rest, OUT levels,
    __global FRAME *restrict marks, __global Bits *restrict closed)
{
    const int base = get_global_id(0) * WORDS * PIXELS, size = min(WORDS * PIXELS, stride - base);
    for (int i = 0; i < size; ++i) {
        const int p = base + i;
        const float bright = levels[p], dark = levels[stride + p], range = bright - dark;
        const int usable = (p < pixels) & (range > 0) & (range - range == 0);  // the last: finite
        const float between = level_between(dark, bright, share, share_rest), level = usable ? between : NAN;
#if BITS == 32
        const FRAME light = RELEASE ? next_up(-level) : level;
        levels[p] = RELEASE ? -level : level;
        levels[stride + p] = RELEASE ? -bright : dark;
        const int answers = usable;
#else
        // Rounded up; a saturated sample is light.
        const float top = ALL, bound = level > 0 ? (level < top ? level : top) : usable ? 0 : top;
        const int whole = (int)bound, reached = whole + (whole < bound);
        const FRAME light = RELEASE ? (FRAME)(ALL - reached + 1) : (FRAME)reached;
        levels[p] = RELEASE ? top - level : level;
        levels[stride + p] = RELEASE ? top - bright : dark;
        const int answers = usable & (reached >= RELEASE);  // what is never dark has no release
#endif
        marks[p] = light;
        closed[stride + p] = answers ? (Bits)0 : ALL;
    }
}

// Finds what is surely dark: samples that miss the level by `tolerance` counts.
__kernel void onset_sure(const int stride, const float tolerance, MAP levels, __global FRAME *restrict marks)
{
    const int base = get_global_id(0) * WORDS * PIXELS, size = min(WORDS * PIXELS, stride - base);
    for (int i = 0; i < size; ++i) {
        const int p = base + i;
        const float sure = levels[p] - tolerance;
        const FRAME light = marks[p];
#if BITS == 32
        const FRAME above = next_up(sure);
#else
        const float bound = sure < ALL ? (sure < -1 ? -1 : sure) : ALL - 1;
        const FRAME above = levels[p] < 0 ? light : (FRAME)((int)(bound + 1));
#endif
        marks[stride + p] = above < light ? above : light;
    }
}

// --- Where a run of light frames begins ------------------------------------------------------------------------

// One bit a frame of the span, the first frame's the lowest.
uint history(const Flags *planes, const int i)
{
    uint bits = planes[0].pixel[i];
#if PLANES > 1
    bits |= (uint)planes[1].pixel[i] << BITS;
#endif
#if PLANES > 2
    bits |= (uint)planes[2].pixel[i] << 2 * BITS | (uint)planes[3].pixel[i] << 3 * BITS;
#endif
    return bits;
}

// The bits at which HOLD bits in a row begin.
uint held(uint bits)
{
#if HOLD > SPAN
    return 0;
#else
    for (int length = 1; length < HOLD; length *= 2)
        bits &= bits >> (length < HOLD - length ? length : HOLD - length);
    return bits;
#endif
}

// Where the run began that is open or decided after the `count` frames from frame `now` on.
int advance(const int known, const uint light, const int now, const int count)
{
    const uint all = ~0u >> (SPAN - count);
    const int missing = HOLD - (now - known);
    const uint wanted = missing < count ? ~(~0u << (missing & (SPAN - 1))) : all;
    const int goes_on = (known >= 0) & ((missing <= 0) | ((light & wanted) == wanted));
    // If the last frame is light, a run is open, and began after the last dark frame, or with the first.
    const int open = light >> (count - 1) & 1, begun = highest_bit(~light & all) + 1;
    const uint runs = held(light);
    int begin = open ? now + begun : DARK;
    begin = runs ? now + lowest_bit(runs) : begin;
    return (goes_on | (known == INVALID)) ? known : begin;
}

#if BITS == 32
// A broken sample spoils a pixel as long as its onset is not decided.
int spoil(const int begin, const uint broken, const int now, const int count)
{
    const int decided = begin + HOLD - 1 - now;
    const int last = begin >= 0 && decided < count ? decided : count - 1;
    return (broken & ~0u >> (SPAN - 1 - (last & (SPAN - 1)))) ? INVALID : begin;
}
#endif

// --- What the samples around it tell ---------------------------------------------------------------------------

#if SAMPLES
// What is known around the onsets of a word.
typedef struct {
    Bits when[PIXELS];  // frame of the onset, counted from two before the span; ALL where there is none to look at
    FRAME before[PIXELS], at[PIXELS], after[PIXELS];  // samples; the last is the lesser of the two that follow
    float waited[PIXELS], doubt[PIXELS];  // frames, and travel beyond the last step, since the pixel was surely dark
} Around;

// Take the samples of pixels whose onset is at a time: one row before it, at it, and the two after it.
void pick(
    const Bits time, __global const FRAME *restrict row, __global const FRAME *restrict before,
    __global const FRAME *restrict first, __global const FRAME *restrict second, Around *restrict around)
{
    for (int i = 0; i < PIXELS; ++i) {
        const FRAME one = SEE(first[i]), two = SEE(second[i]), lesser = LEAST(one, two);
        const FRAME low = SEE(before[i]), high = SEE(row[i]);
        const FRAME old_low = around->before[i], old_high = around->at[i], old_lesser = around->after[i];
        const int here = around->when[i] == time;
        around->before[i] = here ? low : old_low;
        around->at[i] = here ? high : old_high;
        around->after[i] = here ? lesser : old_lesser;
    }
}

// Complete what follows the onsets at a time just before the span: the first sample after it, or the second.
void complete(
    const Bits time, const int whole, __global const FRAME *restrict first, __global const FRAME *restrict second,
    Around *restrict around)
{
    for (int i = 0; i < PIXELS; ++i) {
        const FRAME kept = around->after[i], one = whole ? SEE(first[i]) : kept, two = SEE(second[i]);
        const FRAME lesser = LEAST(one, two);
        around->after[i] = around->when[i] == time ? lesser : kept;
    }
}

// Look up the samples around the onsets that lie in a span, set in `starts`, and after those just before it.
void look_around(
    __global const FRAME *span, const int count, const int pixels, const uint starts, const int was_busy,
    __global const FRAME *last, Around *around)
{
    if (was_busy) {
        complete(0, 0, span, span, around);
        complete(1, 1, span, count > 1 ? span + pixels : span, around);
    }
    for (int t = 0; t < count; ++t) {
        if (!(starts >> t & 1)) continue;
        __global const FRAME *row = span + (size_t)t * pixels, *first = t + 1 < count ? row + pixels : row;
        pick(t + 2, row, t > 0 ? row - pixels : last, first, t + 2 < count ? first + pixels : first, around);
    }
}

// The last surely dark frame from frame `from` of the span backwards; the first of all is taken for dark.
int last_dark(
    __global const FRAME *series, const int from, const int pixels, const int now, const FRAME sure, const FRAME last,
    const int known)
{
    int t = from;
    while (t >= (now == 0) && SEE(series[(size_t)t * pixels]) >= sure) --t;
    return t >= (now == 0) ? now + t : now == 0 ? 0 : SEE(last) < sure ? now - 1 : known;
}

// Height and variance of a pixel: onset.py explains them. All is computed, then chosen, so that it becomes vector code.
float2 answer(
    const Around *around, const int i, const float from, const float step, const float level, const float dark,
    const float noise, const float dark_tolerance, const float light_tolerance)
{
    const float low = around->before[i], high = around->at[i], rise = high - low, steepness = 1 / rise;
    const int from_dark = low <= dark + dark_tolerance, to_light = high >= around->after[i] - light_tolerance;
    const int hovered = (rise <= light_tolerance) | ((around->waited[i] - 2) * rise > 2.5f * light_tolerance);
    const int sudden = from_dark & to_light, guess = from_dark | to_light | hovered, look = !(sudden | hovered);
    const float least = level > low ? level : low, most = least < high ? least : high;
    const float crossed = (most - low) * steepness, rest = 1 - crossed;
    const float share = sudden ? 0.5f : crossed;
    const float slope = step * noise * steepness, width = step + (hovered ? around->doubt[i] : 0);
    const float known = slope * slope * (crossed * crossed + rest * rest), guessed = width * width / 12;
    return (float2)(-(from + step * share), (look ? known : 0) + (guess ? guessed : 0));
}
#endif

// Takes in frames `first` to `first + count` of a press, SPAN by SPAN.
__kernel void onset_scan(
    __global const FRAME *restrict frames, const int count, const int pixels, const int stride, const int first,
    __global const FRAME *restrict marks, __global Word *restrict closed, __global uchar *restrict busy,
    __global int *restrict times
#if SAMPLES
    , MAP levels, MAP travel, const int room,
    const float noise, const float dark_tolerance, const float light_tolerance, __global FRAME *restrict samples,
    OUT answers, __global uchar *restrict status
#endif
    )
{
    const int base = get_global_id(0) * WORDS, words = stride / PIXELS, width = min(WORDS, words - base);
    __global const Word *restrict light = (__global const Word *)marks, *restrict sure = light + words;
    Flags seen[WORDS][PLANES];
#if BITS == 32
    Flags broken[WORDS];
#endif
    uchar open[WORDS];

    for (int start = 0; start < count; start += SPAN) {
        const int now = first + start, length = min(SPAN, count - start), end = now + length;
        __global const FRAME *span = frames + (size_t)start * pixels;
        // What memory can bring while pixels are looked at: the next span, or the first one of the next tile.
        const int last = start + SPAN >= count, ahead = min(SPAN, last ? count : count - start - SPAN);
        __global const FRAME *next = last ? frames + WORDS * PIXELS : span + (size_t)SPAN * pixels;

        for (int w = 0; w < width; ++w) {
            const Word rest = ~closed[base + w];
            open[w] = now == 0 || busy[base + w] || ANY(rest);
        }
        for (int k = (length + BITS - 1) / BITS; k < PLANES; ++k)
            for (int w = 0; w < width; ++w) seen[w][k].word = (Word)(0);
        for (int t = 0; t < length; t += GROUP) {
            const int here = min(GROUP, length - t), plane = t / BITS;
            __global const FRAME *group = span + (size_t)t * pixels;
            for (int w = 0; w < width; ++w) {
                if (!open[w]) continue;
                const Word y = light[base + w];
                Word bits = t % BITS ? seen[w][plane].word : (Word)(0);
#if BITS == 32
                Word bad = t % BITS ? broken[w].word : (Word)(0);
#define NOTE_BROKEN(x, shift) bad |= (BROKEN(x) & TOP) >> shift
#else
#define NOTE_BROKEN(x, shift)
#endif
#define NOTE(i)                                                             \
    const Word x = SEE_WORD(LOAD(group + (size_t)(i) * pixels, base + w));  \
    const uint shift = BITS - 1 - t % BITS - (i);                           \
    bits |= (AT_LEAST(x, y) & TOP) >> shift;                                \
    NOTE_BROKEN(x, shift)
                if (here == GROUP) {
                    #pragma unroll
                    for (int i = 0; i < GROUP; ++i) { NOTE(i); }
                } else {
                    for (int i = 0; i < here; ++i) { NOTE(i); }
                }
                seen[w][plane].word = bits;
#if BITS == 32
                broken[w].word = bad;
#endif
            }
        }

        for (int w = 0; w < width; ++w) {
            const int p = (base + w) * PIXELS;
            for (int t = 0; t < ahead; ++t) FETCH(next + (size_t)t * pixels + p);
            if (!open[w]) continue;
            Flags shut;
            shut.word = closed[now == 0 ? words + base + w : base + w];
            Word news = seen[w][0].word;
            for (int k = 1; k < PLANES; ++k) news |= seen[w][k].word;
#if BITS == 32
            news |= broken[w].word;
#endif
            news &= ~shut.word;
            if (now == 0) {
                for (int i = 0; i < PIXELS; ++i) {
                    times[p + i] = shut.pixel[i] ? INVALID : DARK;
#if SAMPLES
                    times[stride + p + i] = 0;
                    answers[p + i] = answers[stride + p + i] = NAN;
                    status[p + i] = shut.pixel[i] ? 0 : NEVER;
#endif
                }
                closed[base + w] = shut.word;
                busy[base + w] = 0;
            }
            if (busy[base + w] | ANY(news)) {
                const int was_busy = busy[base + w];
                int running = 0, ready = 0;
                uint starts = 0;
                Flags decided;
#if SAMPLES
                Around around;
#endif
                for (int i = 0; i < PIXELS; ++i) {
                    const int known = times[p + i];
                    int begin = advance(known, history(seen[w], i), now, length);
#if BITS == 32
                    const int spoilt = spoil(begin, broken[w].pixel[i], now, length);
                    begin = shut.pixel[i] ? known : spoilt;
                    ready |= begin == INVALID;
#endif
                    const int followed = (begin >= 0) & (now - begin < NEEDED), complete = end - begin >= NEEDED;
                    times[p + i] = begin;
                    const int over = (begin == INVALID) | ((begin >= 0) & (end - begin >= HOLD));
                    decided.pixel[i] = over ? ALL : (Bits)0;
                    running |= followed & !complete;
                    ready |= followed & complete;
#if SAMPLES
                    const int when = begin - now;
                    starts |= begin >= now ? 1u << (when & (SPAN - 1)) : 0;
                    around.when[i] = (followed & (when >= -2)) ? (Bits)(when + 2) : ALL;
#endif
                }
                closed[base + w] = decided.word;
                busy[base + w] = running;
                shut = decided;
#if SAMPLES
                __global FRAME *before = samples + stride + p, *at = before + stride, *after = at + stride;
                if (was_busy)
                    for (int i = 0; i < PIXELS; ++i) {
                        around.before[i] = before[i];
                        around.at[i] = at[i];
                        around.after[i] = after[i];
                    }
                look_around(span + p, length, pixels, starts, was_busy, samples + p, &around);
                Bits doubtful = HOLD > 3 ? was_busy : 0;  // runs that began before `when` can tell
                for (int i = 0; i < PIXELS; ++i)
                    doubtful |= around.before[i] < marks[stride + p + i] ? (Bits)0 : (Bits)~around.when[i];
                for (int i = 0; i < PIXELS; ++i) around.waited[i] = 1;
                for (int i = 0; i < PIXELS; ++i) around.doubt[i] = 0;
                if (doubtful)
                    for (int i = 0; i < PIXELS; ++i) {
                        const int begin = times[p + i];
                        const FRAME surely = marks[stride + p + i];
                        if (begin < 1 || now - begin >= NEEDED || around.before[i] < surely) continue;
                        __global int *dark = times + stride + p + i;
                        if (begin >= now)
                            *dark = last_dark(span + p + i, begin - now - 1, pixels, now, surely, samples[p + i],
                                              *dark);
                        around.waited[i] = begin - *dark;
                        around.doubt[i] = travel[2 * room + begin - 1] - travel[2 * room + *dark];
                    }
                if (ready)
                    for (int i = 0; i < PIXELS; ++i) {
                        const int begin = times[p + i], frame = begin < 1 ? 1 : begin;
                        const int done = (begin >= 0) & (now - begin < NEEDED) & (end - begin >= NEEDED);
                        const int known = done & (begin > 0);
                        const float2 found = answer(&around, i, travel[frame - 1], travel[room + frame], levels[p + i],
                                                    levels[stride + p + i], noise, dark_tolerance,
                                                    light_tolerance);
                        const float height = answers[p + i], sigma = answers[stride + p + i];
                        const uchar was = status[p + i];
                        answers[p + i] = known ? found.x : height;
                        answers[stride + p + i] = known ? found.y * rough_inverse_root(found.y) : sigma;
                        status[p + i] = begin == INVALID ? 0 : done ? (begin == 0 ? FROM_START : 1) : was;
                    }
                if (running)
                    for (int i = 0; i < PIXELS; ++i) {
                        const int begin = times[p + i], dark = times[stride + p + i];
                        const int sudden = (begin > 0) & (around.before[i] < marks[stride + p + i]);
                        times[stride + p + i] = sudden ? begin - 1 : dark;
                        before[i] = around.before[i];
                        at[i] = around.at[i];
                        after[i] = around.after[i];
                    }
#endif
            }
#if SAMPLES
            const Word final = LOAD(span + (size_t)(length - 1) * pixels, base + w), final_seen = SEE_WORD(final);
            Flags hovers;
            hovers.word = AT_LEAST(final_seen, sure[base + w]) & TOP & ~shut.word;
            if (ANY(hovers.word))
                for (int i = 0; i < PIXELS; ++i)
                    if (hovers.pixel[i] && times[p + i] == DARK)
                        times[stride + p + i] =
                            last_dark(span + p + i, length - 1, pixels, now, marks[stride + p + i], samples[p + i],
                                      times[stride + p + i]);
            ((__global Word *)samples)[base + w] = final;
#endif
        }
    }
}

#if SAMPLES
// Answers for the pixels whose run is open or not complete, as if the press ended after `count` frames; `undo` takes
// that back, so that more frames can follow.
__kernel void onset_heights(
    const int count, const int stride, __global const int *restrict times, MAP travel, const int room, OUT answers,
    __global uchar *restrict status, __global const uchar *restrict busy, __global const FRAME *restrict samples,
    MAP levels, const float noise, const float dark_tolerance, const float light_tolerance, const int undo)
{
    const int base = get_global_id(0) * WORDS, width = min(WORDS, stride / PIXELS - base);
    for (int w = 0; w < width; ++w) {
        if (!busy[base + w]) continue;
        const int p = (base + w) * PIXELS;
        Around around;
        for (int i = 0; i < PIXELS; ++i) {
            const int begin = times[p + i];
            if (begin < 0 || count - begin >= NEEDED) continue;
            around.before[i] = samples[stride + p + i];
            around.at[i] = samples[2 * (size_t)stride + p + i];
            around.after[i] = samples[3 * (size_t)stride + p + i];
            const int frame = begin < 1 ? 1 : begin, dark = begin < 1 ? 0 : times[stride + p + i];
            around.waited[i] = frame - dark;
            around.doubt[i] = travel[2 * room + frame - 1] - travel[2 * room + dark];
            const float2 found = answer(&around, i, travel[frame - 1], travel[room + frame], levels[p + i],
                                        levels[stride + p + i], noise, dark_tolerance, light_tolerance);
            const int known = begin > 0 && !undo;
            answers[p + i] = known ? found.x : NAN;
            answers[stride + p + i] = known ? found.y * rough_inverse_root(found.y) : NAN;
            status[p + i] = undo ? NEVER : begin == 0 ? FROM_START : 1;
        }
    }
}
#else
// Heights by the paper's equation 4, at the frame of the onset itself.
__kernel void onset_heights(
    const int stride, __global const int *restrict times, MAP travel, const int room, OUT answers,
    __global uchar *restrict status)
{
    const int base = get_global_id(0) * WORDS * PIXELS, size = min(WORDS * PIXELS, stride - base);
    for (int i = 0; i < size; ++i) {
        const int p = base + i, begin = times[p], frame = begin < 1 ? 1 : begin;
        const float height = -travel[frame], step = travel[room + frame], width = step < 0 ? -step : step;
        answers[p] = begin > 0 ? height : NAN;
        answers[stride + p] = begin > 0 ? width * 0.577350269f : NAN;  // over sqrt(3)
        status[p] = begin > 0 ? 1 : begin == 0 ? FROM_START : begin == DARK ? NEVER : 0;
    }
}
#endif
