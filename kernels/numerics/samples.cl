// Evenly spaced values of an array. Specification: samples.py.
//
// VALUE    type of a value

__kernel void samples_take(
    const int lines, const int rows, const int count, __global const VALUE *restrict values, const int first,
    const int apart, const int down, const int step, __global VALUE *restrict samples)
{
    const int i = get_global_id(0);
    if (i >= lines * rows * count) return;
    const int row = i / count, line = row / rows;
    samples[i] = values[first + (size_t)line * apart + (size_t)(row % rows) * down + (size_t)(i % count) * step];
}
