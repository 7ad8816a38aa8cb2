// Evenly spaced values of an array. Specification: samples.py.
//
// VALUE    type of a value

__kernel void samples_take(
    const int places, const int lines, const int rows, const int count, __global const VALUE *restrict values,
    const int first, const int between, const int apart, const int down, const int step,
    __global VALUE *restrict samples)
{
    const int i = get_global_id(0);
    if (i >= places * lines * rows * count) return;
    const int row = i / count, line = row / rows, place = line / lines;
    samples[i] = values[first + (long)place * between + (long)(line % lines) * apart + (long)(row % rows) * down
                        + (long)(i % count) * step];
}
