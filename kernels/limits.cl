// What memory can give: the least that any kernel does. Specification: limits.py.

#define WORDS (4 * TILE)  // of 64 bytes, an item

__kernel void read_all(__global const uint16 *restrict words, const int count, __global uint *restrict sums)
{
    const int base = get_global_id(0) * WORDS;
    if (base >= count) return;
    const int end = min(count, base + WORDS);
    // Independent sums, or each addition would wait for the one before it.
    uint16 a = (uint16)(0), b = a, c = a, d = a;
    int i = base;
    for (; i + 4 <= end; i += 4) {
        a += words[i];
        b += words[i + 1];
        c += words[i + 2];
        d += words[i + 3];
    }
    for (; i < end; ++i) a += words[i];
    a += b + c + d;
    const uint8 eight = a.lo + a.hi;
    const uint4 four = eight.lo + eight.hi;
    sums[get_global_id(0)] = four.x + four.y + four.z + four.w;
}

__kernel void copy_all(__global const uint16 *restrict words, const int count, __global uint16 *restrict target)
{
    const int base = get_global_id(0) * WORDS;
    const int end = min(count, base + WORDS);
    for (int i = base; i < end; ++i) target[i] = words[i];
}
