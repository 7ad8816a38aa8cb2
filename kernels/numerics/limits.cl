// Limits of memory and arithmetic: minimal kernels. Specification: limits.py.
//
// LANES   4-byte numbers of a word, which is one load: 4 or 16
// WORDS   words of one work-item
// STRIDE  distance between the words of a work-item: 1 on a CPU, where an item reads contiguously; the size of a
//         work-group on a GPU, where adjacent items read adjacent words

#include "common.clh"

typedef JOIN(uint, LANES) WORD;
typedef JOIN(float, LANES) NUMBERS;

// An item's words are this one and every STRIDE-th after it.
long first_word(void)
{
    const long item = get_global_id(0);
    return item / STRIDE * STRIDE * WORDS + item % STRIDE;
}

__kernel void read_all(__global const WORD *restrict words, const int count, __global WORD *restrict sums)
{
    const long first = first_word();
    if (first >= count) return;
    const long end = min((long)count, first + STRIDE * WORDS);
    // Independent sums, so that additions do not wait for each other.
    WORD a = 0, b = 0, c = 0, d = 0;
    long i = first;
    for (; i + 3 * STRIDE < end; i += 4 * STRIDE) {
        a += words[i];
        b += words[i + STRIDE];
        c += words[i + 2 * STRIDE];
        d += words[i + 3 * STRIDE];
    }
    for (; i < end; i += STRIDE) a += words[i];
    sums[get_global_id(0)] = a + b + c + d;
}

__kernel void copy_all(__global WORD *words, const int count)
{
    const long first = first_word();
    const long end = min((long)count, first + STRIDE * WORDS);
    for (long i = first; i < end; i += STRIDE) words[count + i] = words[i];
}

__kernel void triad_all(__global WORD *words, const int count, const uint scale)
{
    const long first = first_word();
    const long end = min((long)count, first + STRIDE * WORDS);
    for (long i = first; i < end; i += STRIDE) words[2L * count + i] = words[i] + scale * words[count + i];
}

// WORDS is 8 here: as many independent sums.
__kernel void multiply_all(
    __global NUMBERS *restrict numbers, const int count, const int steps, const float factor, const float summand)
{
    const long first = first_word();
    if (first + 7 * STRIDE >= count) return;
    __global NUMBERS *restrict mine = numbers + first;
    NUMBERS a = mine[0], b = mine[STRIDE], c = mine[2 * STRIDE], d = mine[3 * STRIDE];
    NUMBERS e = mine[4 * STRIDE], f = mine[5 * STRIDE], g = mine[6 * STRIDE], h = mine[7 * STRIDE];
    for (int i = 0; i < steps; ++i) {
        a = a * factor + summand;
        b = b * factor + summand;
        c = c * factor + summand;
        d = d * factor + summand;
        e = e * factor + summand;
        f = f * factor + summand;
        g = g * factor + summand;
        h = h * factor + summand;
    }
    mine[0] = a;
    mine[STRIDE] = b;
    mine[2 * STRIDE] = c;
    mine[3 * STRIDE] = d;
    mine[4 * STRIDE] = e;
    mine[5 * STRIDE] = f;
    mine[6 * STRIDE] = g;
    mine[7 * STRIDE] = h;
}
