// Evenly spaced values of an array. Specification: samples.py.
//
// VALUE    type of a value

__kernel void samples_take(
    const int lines, const int count, __global const VALUE *restrict values, const int first, const int apart,
    const int step, __global VALUE *restrict samples)
{
    const int i = get_global_id(0);
    if (i >= lines * count) return;
    samples[i] = values[first + (size_t)(i / count) * apart + (size_t)(i % count) * step];
}
