// Heights of the connected components of a surface. Specification: components.py.
//
// TILE     pixels of one work-item: 1 on a GPU, many on a CPU
// ONE      1 if there is one component: labels are then not read
// GROUP    work-items that sum one component of a strip together, and compute the offset of one component; 1 if an item
//          sums all components of its strip
//
// PoCL vectorises loops without branches.

#pragma OPENCL FP_CONTRACT OFF
#include "common.clh"

#define SLOPE 4
#define KNOWN 8
#define WIDE 8

#define CHUNK (TILE < 256 ? TILE : 256)

#define ANSWERED(p) (flags[p] & (SLOPE | KNOWN))
#define RISEN(p, column) (relief[p] + (start + plane_x * (column)))

#if ONE
#define LABEL(p) 0
#define IS_OF(p, component) 1
#else
#define LABEL(p) (labels[p] > 0 ? labels[p] : 0)
#define IS_OF(p, component) (labels[p] == (component))
#endif

// Both values are loaded before one is selected, which avoids a branch.
float chosen(const int which, const float if_true, const float if_false)
{
    return which ? if_true : if_false;
}

// The averaged quantity: heights, or their excess over the known heights.
#define SHARE(p) (heights ? chosen(flags[p] & KNOWN, height_weights ? height_weights[p] : 1.0f, 0.0f) \
                          : chosen(ANSWERED(p), 1.0f, 0.0f))
#define VALUE(p, column) (heights ? RISEN(p, column) - heights[p] : RISEN(p, column))

#define ADD(sum, total, p, column) {                                                                   \
    const float weight = SHARE(p), value = weight * VALUE(p, column);                                  \
    sum += weight > 0.0f ? value : 0.0f;                                                               \
    total += weight;                                                                                   \
}

// Sums over strips of rows, each into its own row of the output.
__kernel GROUP_SIZE void components_sum(
    const int rows, const int columns, __global const uchar *restrict flags, __global const int *restrict labels,
    MAP reliefs, const int place, const float plane_x, const float plane_y, const float plane_z, MAP heights, MAP height_weights,
    const int strip, const int components, OUT sums, OUT totals)
{
#if GROUP > 1
    __local float some[GROUP], share_of[GROUP];
    const int lane = get_local_id(0), lanes = get_local_size(0);
    const int item = get_group_id(0) / components, component = get_group_id(0) % components;
    const int top = item * strip, bottom = LESSER(rows, top + strip);
    MAP relief = reliefs + (long)place * rows * columns;
    float part = 0.0f, shares = 0.0f;
    for (int row = top; row < bottom; ++row) {
        const float start = plane_z + plane_y * row;
        const int first = row * columns;
        for (int column = lane; column < columns; column += lanes)
            if (IS_OF(first + column, component)) ADD(part, shares, first + column, column)
    }
    some[lane] = part;
    share_of[lane] = shares;
    GROUP_SUM(some, lanes)
    GROUP_SUM(share_of, lanes)
    if (lane == 0 && top < rows) {
        sums[item * components + component] = some[0];
        totals[item * components + component] = share_of[0];
    }
#else
    const int item = get_global_id(0), top = item * strip, bottom = LESSER(rows, top + strip);
    if (top >= rows) return;
    MAP relief = reliefs + (long)place * rows * columns;
    __global float *sum = sums + item * components, *total = totals + item * components;
    for (int component = 0; component < components; ++component) sum[component] = total[component] = 0.0f;
    for (int row = top; row < bottom; ++row) {
        const float start = plane_z + plane_y * row;
        const int first = row * columns;
#if ONE
        float some[WIDE] = {0, 0, 0, 0, 0, 0, 0, 0}, share_of[WIDE] = {0, 0, 0, 0, 0, 0, 0, 0};
        int column = 0;
        for (; column + WIDE <= columns; column += WIDE)
            for (int lane = 0; lane < WIDE; ++lane)
                ADD(some[lane], share_of[lane], first + column + lane, column + lane)
        for (; column < columns; ++column) ADD(some[0], share_of[0], first + column, column)
        for (int lane = 0; lane < WIDE; ++lane) {
            sum[0] += some[lane];
            total[0] += share_of[lane];
        }
#else
        // Adjacent pixels of one component are summed first: sums in memory are slow and lose digits.
        int component = -1;
        float part[WIDE] = {0}, shares[WIDE] = {0};
        for (int column = 0; column <= columns;) {
            int same = column + WIDE <= columns;
            for (int lane = 0; lane < WIDE && same; ++lane) same &= labels[first + column + lane] == component;
            if (same) {
                for (int lane = 0; lane < WIDE && component >= 0; ++lane)
                    ADD(part[lane], shares[lane], first + column + lane, column + lane)
                column += WIDE;
                continue;
            }
            const int label = column < columns ? labels[first + column] : -1;
            if (label != component) {
                for (int lane = 0; lane < WIDE; ++lane) {
                    if (component >= 0) {
                        sum[component] += part[lane];
                        total[component] += shares[lane];
                    }
                    part[lane] = shares[lane] = 0.0f;
                }
                component = label;
            }
            if (label >= 0) ADD(part[0], shares[0], first + column, column)
            ++column;
        }
#endif
    }
#endif
}

// Offsets that give components without a known height, or all others, their mean: `mean` and its remainder.
__kernel GROUP_SIZE void components_offsets(
    const int strips, const int components, MAP sums, MAP totals, __global const uchar *restrict unknown,
    const int of_unknown, const float mean, const float mean_rest, OUT offsets)
{
    const int component = get_global_id(0) / GROUP, lane = GROUP > 1 ? get_local_id(0) : 0;
    Pair sum = {0.0f, 0.0f}, total = {0.0f, 0.0f};
    for (int strip = lane; strip < strips && component < components; strip += GROUP) {
        sum = plus(sum, (Pair){sums[strip * components + component], 0.0f});
        total = plus(total, (Pair){totals[strip * components + component], 0.0f});
    }
#if GROUP > 1
    __local Pair some[GROUP], share_of[GROUP];
    some[lane] = sum;
    share_of[lane] = total;
    for (int reach = GROUP / 2; reach > 0; reach /= 2) {
        barrier(CLK_LOCAL_MEM_FENCE);
        if (lane < reach) {
            some[lane] = plus(some[lane], some[lane + reach]);
            share_of[lane] = plus(share_of[lane], share_of[lane + reach]);
        }
    }
    sum = some[0];
    total = share_of[0];
#endif
    if (lane > 0 || component >= components || unknown[component] != of_unknown) return;
    sum = normalised(sum);
    total = normalised(total);
    const float one = total.high > 0.0f ? total.high : 1.0f, ratio = sum.high / one;
    const Pair remainder = normalised(minus(sum, times((Pair){ratio, 0.0f}, total)));
    offsets[component] = normalised(minus((Pair){mean, mean_rest}, sum_of(ratio, remainder.high / one))).high;
}

__kernel void components_add_offsets(
    const int rows, const int columns, __global const uchar *restrict flags, __global const int *restrict labels,
    MAP reliefs, const int place, const float plane_x, const float plane_y, const float plane_z, MAP offsets, OUT heights)
{
    const int chunks = (columns + CHUNK - 1) / CHUNK, item = get_global_id(0);
    const int row = item / chunks, begin = item % chunks * CHUNK, end = LESSER(columns, begin + CHUNK);
    if (row >= rows) return;
    MAP relief = reliefs + (long)place * rows * columns;
    OUT height = heights + (long)place * rows * columns;
    const float start = plane_z + plane_y * row;
    const int first = row * columns;
    for (int column = begin; column < end; ++column) {
        const int p = first + column;
        height[p] = chosen(ANSWERED(p), RISEN(p, column) + offsets[LABEL(p)], NAN);
    }
}
