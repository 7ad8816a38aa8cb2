// Contact of a rigid surface with an elastic half-space near an earlier one. Specification: contact.py.
//
// TILE     1 on a GPU; otherwise an item processes LANES columns or waves at once
// GROUP    items of a work-group
// BINNING  pixels on a side of a block

#include "common.clh"

#if TILE > 1
#define LANES 8
#else
#define LANES 1
#endif
#include "lanes.clh"

#if LANES > 1
#define ORDER (F)(0, 1, 2, 3, 4, 5, 6, 7)
#else
#define ORDER 0.0f
#endif

#define UNROLL _Pragma("unroll")
#define INLINE static inline __attribute__((always_inline))

#define NOTHING -1e30f
#define WIDE 64
#define MOST_CHANGES 40
#define MOST_STEPS 300
#define TINY 1.17549435e-38f
#define PLANES 8
#define NUMBERS 25
#define MARGIN 2  // blocks around a contact, and the share of its length, in which other maps are averaged
#define SHARE 16

#define DOWN 6  // rows and vectors of a block of sums
#define OVER 2
#define SPAN (OVER * LANES)

typedef F __attribute__((aligned(4))) Lanes;
#define LOAD(memory) (*(__global const Lanes *)(memory))
#define STORE(values, memory) (*(__global Lanes *)(memory) = (values))

INLINE float greatest_lane(const F values)
{
#if LANES > 1
    float greatest = values[0];
    UNROLL for (int lane = 1; lane < LANES; ++lane) greatest = GREATER(greatest, values[lane]);
    return greatest;
#else
    return values;
#endif
}

// The result of all items of a group; each of them gets it.
#if ITEMS > 1
#define REDUCTION(name, combined)                                                                                 \
    INLINE float name(__local float *room, const float own)                                                       \
    {                                                                                                             \
        room[get_local_id(0)] = own;                                                                              \
        barrier(CLK_LOCAL_MEM_FENCE);                                                                             \
        float a = room[0];                                                                                        \
        for (int k = 1; k < ITEMS; ++k) {                                                                         \
            const float b = room[k];                                                                              \
            a = combined;                                                                                         \
        }                                                                                                         \
        barrier(CLK_LOCAL_MEM_FENCE);                                                                             \
        return a;                                                                                                 \
    }
#else
#define REDUCTION(name, combined) \
    INLINE float name(__local float *room, const float own) { return own; }
#endif
REDUCTION(sum_of_items, a + b)
REDUCTION(greatest_of_items, GREATER(a, b))

// Rows from top to bottom, and columns from left to right, without the last; columns are multiples of LANES.
typedef struct { int top, bottom, left, right; } Box;

// Loops over the vectors of a box, at the places p in rows i of all parts, and over the blocks of a map. An
// item of its own does not divide.
#if ITEMS > 1
#define FOR_BOX(p, i, w, box)                                                                                     \
    for (int n = item, width = ((box).right - (box).left) / LANES, high = (box).bottom - (box).top, p, i;         \
         n < (w)->parts * high * width                                                                            \
         && (i = (box).top + n / width % high,                                                                    \
             p = (n / width / high * (w)->rows + i) * (w)->columns + (box).left + n % width * LANES, true);       \
         n += ITEMS)
#define FOR_BLOCKS(p, i, j, rows, columns)                                                                        \
    for (int p = item, i, j; p < (rows) * (columns) && (i = p / (columns), j = p % (columns), true); p += ITEMS)
#else
#define FOR_BOX(p, i, w, box)                                                                                     \
    for (int part = 0; part < (w)->parts; ++part)                                                                 \
        for (int i = (box).top; i < (box).bottom; ++i)                                                            \
            for (int p = (part * (w)->rows + i) * (w)->columns + (box).left,                                      \
                     end = p + (box).right - (box).left;                                                          \
                 p < end; p += LANES)
#define FOR_BLOCKS(p, i, j, rows, columns)                                                                        \
    for (int i = 0, p = 0; i < (rows); ++i)                                                                       \
        for (int j = 0; j < (columns); ++j, ++p)
#endif
#define IN_PLANE(p) ((p) < size ? (p) : (p) - size)

// A window of the half-space, the waves along its rows, and memory. Pressures have one part, tractions two,
// along x and along rows.
typedef struct {
    int parts, rows, columns, reach;  // rows of a table
    float lift;  // displacement of all pixels by unit strain on one, by the stage
    __global const float *basis, *across, *weights, *inverse;
    __global float *waves, *mixed;  // (parts, rows, 2 * columns)
    __global float *moved, *direction, *along, *residual, *last, *steepest;  // (parts, rows, columns)
    __local float *room;
} Window;

#define WORK 10  // maps of a window in the memory of a group, for each part

INLINE Window window_of(
    const int parts, const int rows, const int columns, const int reach, const float lift,
    __global const float *basis, __global const float *across, __global const float *weights,
    __global const float *inverse, __global float *work, __local float *room)
{
    const int size = parts * rows * columns;
    work += get_group_id(0) * WORK * size;
    return (Window){parts, rows, columns, reach, lift, basis, across, weights, inverse, work, work + 2 * size,
                    work + 4 * size, work + 5 * size, work + 6 * size, work + 7 * size, work + 8 * size,
                    work + 9 * size, room};
}

// The convolution of values in a box with a kernel, whose transforms are ``weights``, in another box.
INLINE void convolve(
    const Window *w, __global const float *weights, const Box from, const Box to, __global const float *values,
    __global float *result)
{
    const int item = get_local_id(0), columns = w->columns, waves = 2 * columns, rows = w->rows;
    const int blocks = waves / SPAN, high = (from.bottom - from.top + DOWN - 1) / DOWN;
    for (int n = item; n < w->parts * high * blocks; n += ITEMS) {
        const int first = n / blocks / high * rows, k = n % blocks * SPAN;
        const int i = from.top + n / blocks % high * DOWN;
        __global const float *basis = w->basis + k;
        F sum[DOWN][OVER];
        int row[DOWN];
        UNROLL for (int r = 0; r < DOWN; ++r) {
            row[r] = (first + LESSER(i + r, from.bottom - 1)) * columns;
            UNROLL for (int a = 0; a < OVER; ++a) sum[r][a] = 0.0f;
        }
        for (int m = from.left; m < from.right; ++m) {
            F wave[OVER];
            UNROLL for (int a = 0; a < OVER; ++a) wave[a] = LOAD(basis + m * waves + a * LANES);
            UNROLL for (int r = 0; r < DOWN; ++r) {
                const float value = values[row[r] + m];
                UNROLL for (int a = 0; a < OVER; ++a) sum[r][a] += value * wave[a];
            }
        }
        UNROLL for (int r = 0; r < DOWN; ++r)
            UNROLL for (int a = 0; a < OVER; ++a)
                if (i + r < from.bottom) STORE(sum[r][a], w->waves + (first + i + r) * waves + k + a * LANES);
    }
    BARRIER;
    const int higher = (to.bottom - to.top + DOWN - 1) / DOWN;
    for (int n = item; n < w->parts * higher * blocks; n += ITEMS) {
        const int part = n / blocks / higher, first = part * rows, k = n % blocks * SPAN;
        const int i = to.top + n / blocks % higher * DOWN;
        __global const float *own = w->waves + first * waves + k, *other = w->waves + (rows - first) * waves;
        __global const float *weight = weights + part * w->reach * waves + k;
        F sum[DOWN][OVER];
        UNROLL for (int r = 0; r < DOWN; ++r)
            UNROLL for (int a = 0; a < OVER; ++a) sum[r][a] = 0.0f;
        for (int l = from.top; l < from.bottom; ++l) {
            F wave[OVER];
            UNROLL for (int a = 0; a < OVER; ++a) wave[a] = LOAD(own + l * waves + a * LANES);
            UNROLL for (int r = 0; r < DOWN; ++r) {
                const int distance = LESSER(i + r, to.bottom - 1) - l, at = (distance < 0 ? -distance : distance) * waves;
                UNROLL for (int a = 0; a < OVER; ++a) sum[r][a] += LOAD(weight + at + a * LANES) * wave[a];
            }
            if (w->parts == 1) continue;
            // The kernel between parts is odd, so that it turns cosines into sines, which are a half further.
            __global const float *odd = weights + 2 * w->reach * waves + k;
            UNROLL for (int a = 0; a < OVER; ++a) {
                const int place = k + a * LANES;
                wave[a] = LOAD(other + l * waves + (place < columns ? place + columns : place - columns));
            }
            UNROLL for (int r = 0; r < DOWN; ++r) {
                const int distance = LESSER(i + r, to.bottom - 1) - l, at = (distance < 0 ? -distance : distance) * waves;
                const float sign = distance < 0 ? -1.0f : 1.0f;
                UNROLL for (int a = 0; a < OVER; ++a) sum[r][a] += sign * LOAD(odd + at + a * LANES) * wave[a];
            }
        }
        UNROLL for (int r = 0; r < DOWN; ++r)
            UNROLL for (int a = 0; a < OVER; ++a)
                if (i + r < to.bottom) STORE(sum[r][a], w->mixed + (first + i + r) * waves + k + a * LANES);
    }
    BARRIER;
    const int wide = (to.right - to.left + SPAN - 1) / SPAN;
    for (int n = item; n < w->parts * higher * wide; n += ITEMS) {
        const int first = n / wide / higher * rows, j = to.left + n % wide * SPAN;
        const int i = to.top + n / wide % higher * DOWN;
        F sum[DOWN][OVER];
        int row[DOWN], place[OVER];
        UNROLL for (int a = 0; a < OVER; ++a) place[a] = LESSER(j + a * LANES, to.right - LANES);
        UNROLL for (int r = 0; r < DOWN; ++r) {
            row[r] = (first + LESSER(i + r, to.bottom - 1)) * waves;
            UNROLL for (int a = 0; a < OVER; ++a) sum[r][a] = 0.0f;
        }
        for (int k = 0; k < waves; ++k) {
            F wave[OVER];
            UNROLL for (int a = 0; a < OVER; ++a) wave[a] = LOAD(w->across + k * columns + place[a]);
            UNROLL for (int r = 0; r < DOWN; ++r) {
                const float value = w->mixed[row[r] + k];
                UNROLL for (int a = 0; a < OVER; ++a) sum[r][a] += value * wave[a];
            }
        }
        UNROLL for (int r = 0; r < DOWN; ++r)
            UNROLL for (int a = 0; a < OVER; ++a)
                if (i + r < to.bottom) STORE(sum[r][a], result + (first + i + r) * columns + place[a]);
    }
    BARRIER;
}

INLINE Box whole(const Window *w) { return (Box){0, w->rows, 0, w->columns}; }

// The displacement of a box by the strain in another one, against the stage.
INLINE void displace(
    const Window *w, const Box box, const Box to, __global const float *strain, __global float *moved)
{
    const int item = get_local_id(0);
    convolve(w, w->weights, box, to, strain, moved);
#if ITEMS == 1  // barriers are in no branch: PoCL would copy all that follows one
    if (w->lift == 0) return;
#endif
    F sum = 0.0f;
    FOR_BOX(p, i, w, box) sum += LOAD(strain + p);
    const float all = w->lift * sum_of_items(w->room, sum_over_lanes(sum));
    FOR_BOX(p, i, w, to) STORE(LOAD(moved + p) + all, moved + p);
    BARRIER;
}

// The smallest box that contains a contact.
INLINE Box box_of(const Window *w, __global const float *contact)
{
    const int item = get_local_id(0), columns = w->columns;
    int first = w->rows, last = 0, begin = columns, end = 0;
#if ITEMS > 1
    FOR_BLOCKS(p, i, j, w->rows, columns) {
        if (contact[p] == 0) continue;
        first = LESSER(first, i);
        last = GREATER(last, i + 1);
        begin = LESSER(begin, j);
        end = GREATER(end, j + 1);
    }
    first = -greatest_of_items(w->room, -first);
    last = greatest_of_items(w->room, last);
    begin = -greatest_of_items(w->room, -begin);
    end = greatest_of_items(w->room, end);
#else
    __global float *down = w->mixed;  // sums of columns
    for (int j = 0; j < columns; ++j) down[j] = 0;
    for (int i = 0; i < w->rows; ++i) {
        F across = 0.0f;
        for (int j = 0; j < columns; j += LANES) {
            const F touches = LOAD(contact + i * columns + j);
            across += touches;
            STORE(LOAD(down + j) + touches, down + j);
        }
        if (sum_over_lanes(across) == 0) continue;
        first = LESSER(first, i);
        last = i + 1;
    }
    for (int j = 0; j < columns; ++j) {
        if (down[j] == 0) continue;
        begin = LESSER(begin, j);
        end = j + 1;
    }
#endif
    if (last == 0) return (Box){0, 0, 0, 0};
    const int width = (end - begin + LANES - 1) / LANES * LANES, start = LESSER(begin, columns - width);
    return (Box){first, last, start, start + width};
}

// Solves for the strain with which the sheet follows a target in contact, by conjugate gradients. ``moved`` is
// the displacement of a box by this strain, before and after. Returns whether the largest gap is at most a
// tolerance.
INLINE bool solve(
    const Window *w, const Box box, const Box to, const float tolerance, __global const float *target,
    __global const float *contact, __global float *strain)
{
    const int item = get_local_id(0), size = w->rows * w->columns;
    __global float *residual = w->residual, *last = w->last;
    float gain = 0;
    for (int step = 0;; ++step) {
        F most = 0.0f;
        FOR_BOX(p, i, w, box) {
            const F rest = LOAD(contact + IN_PLANE(p)) * (LOAD(target + p) - LOAD(w->moved + p));
            STORE(rest, residual + p);
            most = GREATER(most, GREATER(rest, -rest));
        }
        BARRIER;
        const float error = greatest_of_items(w->room, greatest_lane(most));
        if (error <= tolerance || step == MOST_STEPS) return error <= tolerance;
        convolve(w, w->inverse, box, box, residual, w->steepest);
        F now = 0.0f, both = 0.0f;
        FOR_BOX(p, i, w, box) {
            const F steepest = LOAD(contact + IN_PLANE(p)) * LOAD(w->steepest + p);
            STORE(steepest, w->steepest + p);
            now += LOAD(residual + p) * steepest;
            if (step > 0) both += LOAD(last + p) * steepest;
        }
        const float before = gain;
        gain = sum_of_items(w->room, sum_over_lanes(now));
        const float more = gain - sum_of_items(w->room, sum_over_lanes(both));
        const float memory = step > 0 ? GREATER(more, 0.0f) / GREATER(before, TINY) : 0.0f;
        F slope = 0.0f, stiff = 0.0f;
        FOR_BOX(p, i, w, box) {
            const F steepest = LOAD(w->steepest + p);
            const F direction = step > 0 ? steepest + memory * LOAD(w->direction + p) : steepest;
            STORE(direction, w->direction + p);
            slope += LOAD(residual + p) * direction;
        }
        BARRIER;
        displace(w, box, to, w->direction, w->along);
        FOR_BOX(p, i, w, box) stiff += LOAD(w->direction + p) * LOAD(w->along + p);
        const float length = sum_of_items(w->room, sum_over_lanes(slope))
            / GREATER(sum_of_items(w->room, sum_over_lanes(stiff)), TINY);
        FOR_BOX(p, i, w, box) STORE(LOAD(strain + p) + length * LOAD(w->direction + p), strain + p);
        FOR_BOX(p, i, w, to) STORE(LOAD(w->moved + p) + length * LOAD(w->along + p), w->moved + p);
        BARRIER;
        __global float *other = last;
        last = residual;
        residual = other;
    }
}

#define IS_FINITE(value) ((value) - (value) == 0)

// The mean of the defined pixels of a block, or of their squares; NaN if most are undefined.
INLINE float mean_of_block(
    const int map_columns, const int kinds, const bool squared, const int row, const int column, MAP map)
{
    float sum = 0;
    int count = 0;
    for (int y = 0; y < BINNING; ++y)
        for (int x = 0; x < BINNING; ++x) {
            const float value = map[((row * BINNING + y) * map_columns + column * BINNING + x) * kinds];
            if (!IS_FINITE(value)) continue;
            sum += squared ? value * value : value;
            ++count;
        }
    return 2 * count >= BINNING * BINNING ? sum / count : NAN;
}

// Means of blocks of a map, whose pixels have values of some kinds, in a box of blocks, or of their squares. Each
// kind has its own plane.
INLINE void average(
    const int map_columns, const int kinds, const bool squared, const Box box, MAP map, __global float *strip,
    const int columns, const int plane, __global float *means)
{
    const int item = get_local_id(0);
#if LANES > 1
    const int begin = box.left * BINNING * kinds, length = (box.right - box.left) * BINNING * kinds;
    for (int row = box.top; row < box.bottom; ++row) {
        MAP first = map + row * BINNING * map_columns * kinds + begin;
        for (int n = 0; n < length; n += LANES) {
            F sum = 0.0f;
            UNROLL for (int y = 0; y < BINNING; ++y) {
                const F values = LOAD(first + y * map_columns * kinds + n);
                sum += squared ? values * values : values;
            }
            STORE(sum, strip + n);
        }
        for (int kind = 0; kind < kinds; ++kind)
            for (int column = box.left; column < box.right; ++column) {
                __global const float *part = strip + (column - box.left) * BINNING * kinds + kind;
                float sum = 0;
                UNROLL for (int x = 0; x < BINNING; ++x) sum += part[x * kinds];
                means[kind * plane + (row - box.top) * columns + column - box.left] = IS_FINITE(sum)
                    ? sum * (1.0f / (BINNING * BINNING))
                    : mean_of_block(map_columns, kinds, squared, row, column, map + kind);
            }
    }
#else
    const int wide = box.right - box.left, size = wide * (box.bottom - box.top);
    for (int n = item; n < kinds * size; n += ITEMS) {
        const int kind = n / size, row = n % size / wide, column = n % wide;
        means[kind * plane + row * columns + column]
            = mean_of_block(map_columns, kinds, squared, box.top + row, box.left + column, map + kind);
    }
#endif
}

// Values at the centres of blocks, from means, which are lower on a dome, and the greatest one.
INLINE float centre(
    const int rows, const int columns, const float bend, const float travel, __global const float *means,
    __global float *values, __local float *room)
{
    const int item = get_local_id(0);
    float greatest = NOTHING;
    FOR_BLOCKS(p, i, j, rows, columns) {
        float across = 0, down = 0;
        if (j > 0 && j < columns - 1) across = means[p - 1] - 2 * means[p] + means[p + 1];
        if (i > 0 && i < rows - 1) down = means[p - columns] - 2 * means[p] + means[p + columns];
        if (!IS_FINITE(across)) across = 0;
        if (!IS_FINITE(down)) down = 0;
        const float value = means[p] - bend * (across + down) + travel;
        values[p] = value;
        if (value > greatest) greatest = value;
    }
    return greatest_of_items(room, greatest);
}

// The sums of contact.py over a window.
INLINE void sum_up(
    const Window *w, const float lost, __global const float *loads, __global const float *sheet,
    __global float *parts, __global float *numbers)
{
    const int item = get_local_id(0), columns = w->columns, size = w->rows * columns;
    const Box everywhere = whole(w);
    __global const float *contact = sheet + 2 * size;
    F sums[NUMBERS];
    for (int n = 0; n < NUMBERS; ++n) sums[n] = 0.0f;
    FOR_BOX(p, i, w, everywhere) {
        const F pulled = LOAD(sheet + size + p), strain = GREATER(pulled, (F)0.0f), gap = LOAD(sheet + p);
        const F touches = LOAD(contact + p), variance = LOAD(sheet + 3 * size + p);
        const F x = (float)(p - i * columns) - 0.5f * (columns - 1) + ORDER, y = i - 0.5f * (w->rows - 1);
        const F punched = touches - LOAD(loads + 10 * size + p), before = LOAD(loads + 11 * size + p);
        sums[0] += strain;
        sums[1] += strain * x;
        sums[2] += strain * y;
        sums[3] += strain * x * x;
        sums[4] += strain * y * y;
        sums[5] += touches;
        sums[7] += punched * punched;
        sums[8] += (touches - before) * (touches - before);
        sums[9] += before;
        // Of the standard deviation, the inverse.
        sums[11] += touches * inverse_roots(GREATER(variance, (F)1e-30f));
        F weights[3];
        UNROLL for (int n = 0; n < 3; ++n) {
            sums[12 + n] += LOAD(loads + n * size + p) * gap;
            weights[n] = LOAD(loads + (3 + n) * size + p);
        }
        UNROLL for (int n = 0; n < 3; ++n)
            UNROLL for (int m = n; m < 3; ++m) sums[15 + n * (5 - n) / 2 + m] += weights[n] * weights[m] * variance;
        UNROLL for (int k = 0; k < 2; ++k)
            UNROLL for (int part = 0; part < 2; ++part) {
                const F weight = LOAD(loads + (6 + 2 * k + part) * size + p);
                sums[21 + k] += weight * LOAD(sheet + (4 + part) * size + p);
                sums[23 + k] += weight * weight * LOAD(sheet + (6 + part) * size + p);
            }
    }
    float border = 0;
    FOR_BLOCKS(p, i, j, w->rows, columns) {
        if (contact[p] == 0) continue;
        border += i == 0 || j == 0 || i == w->rows - 1 || j == columns - 1 || contact[p - 1] == 0 || contact[p + 1] == 0
            || contact[p - columns] == 0 || contact[p + columns] == 0;
    }
#if ITEMS > 1
    for (int n = 0; n < NUMBERS; ++n) parts[n * ITEMS + item] = n == 6 ? border : n == 10 ? lost : sums[n];
    BARRIER;
    for (int n = item; n < NUMBERS; n += ITEMS) {
        float total = 0;
        for (int k = 0; k < ITEMS; ++k) total += parts[n * ITEMS + k];
        numbers[n] = total;
    }
#else
    for (int n = 0; n < NUMBERS; ++n) numbers[n] = n == 6 ? border : n == 10 ? lost : sum_over_lanes(sums[n]);
#endif
}

// The means of maps, and the contact near an earlier one, by one work-group.
__kernel GROUP_SIZE void contact_follow(
    const int map_rows, const int map_columns, const int top, const int left, const int rows, const int columns,
    const int reach, const int is_same, const float travel, const float bend, const float loose, const float least, const float lift,
    const float own, const int sigma_kinds, const int displacement_kinds, const int displacement_sigma_kinds, MAP height, MAP sigma,
    MAP displacement, MAP displacement_sigma, MAP basis, MAP across, MAP weights, MAP inverse, MAP loads,
    __global float *work, __global float *found)
{
    __local float room[ITEMS];
    const int item = get_local_id(0), size = rows * columns;
    const int high = map_rows / BINNING, wide = map_columns / BINNING;
    const Window window = window_of(1, rows, columns, reach, lift, basis, across, weights, inverse, work, room);
    __global float *sheet = found + high * wide, *surface = sheet, *strain = sheet + size, *contact = sheet + 2 * size;
    __global float *means = work + WORK * size, *strip = means + high * wide;
    average(map_columns, 1, false, (Box){0, high, 0, wide}, height, strip, wide, 0, means);
    BARRIER;
    const float highest = centre(high, wide, bend, travel, means, found, room);
    BARRIER;
    const float tolerance = GREATER(loose * highest, least), pull = tolerance / own;
    float freed = 0;
    FOR_BLOCKS(p, i, j, rows, columns) {
        const float value = top + i < high && left + j < wide ? found[(top + i) * wide + left + j] : NOTHING;
        const bool is_near = contact[p] != 0 && value > 0;
        surface[p] = IS_FINITE(value) ? value : NOTHING;
        contact[p] = is_near;
        freed += !is_near && strain[p] != 0;
        strain[p] = is_near ? strain[p] : 0;
    }
    BARRIER;
    const float all_freed = sum_of_items(room, freed);
    bool is_moved = is_same && all_freed == 0, is_found = false;
    for (int round = 0; round < MOST_CHANGES && !is_found; ++round) {
        const Box box = box_of(&window, contact);
        // In a wide window, the displacement outside of the contact is computed once for all steps.
        const bool is_wide = ITEMS > 1 || columns > WIDE;
        const Box to = is_wide ? box : whole(&window);
#if ITEMS == 1
        if (!is_moved)
#endif
            displace(&window, box, to, strain, window.moved);
        const bool is_solved = solve(&window, box, to, tolerance, surface, contact, strain);
        if (is_wide) displace(&window, box, whole(&window), strain, window.moved);
        F changes = 0.0f, removed = 0.0f;
        const Box everywhere = whole(&window);
        FOR_BOX(p, i, &window, everywhere) {
            const F before = LOAD(contact + p), pressure = LOAD(strain + p), gap = LOAD(window.moved + p) - LOAD(surface + p);
            const F pushes = pressure > -pull ? (F)1.0f : (F)0.0f, overlaps = gap < -tolerance ? (F)1.0f : (F)0.0f;
            const F now = before > 0.0f ? pushes : overlaps;
            changes += (now - before) * (now - before);
            removed += (1.0f - now) * pressure * pressure;
            STORE(now * pressure, strain + p);
            STORE(now, contact + p);
        }
        BARRIER;
        const float all_removed = sum_of_items(room, sum_over_lanes(removed));
        const float all_changes = sum_of_items(room, sum_over_lanes(changes));
        is_moved = all_removed == 0;
        is_found = is_solved && all_changes == 0;
    }
    float lost = 0;
    FOR_BLOCKS(p, i, j, rows, columns) {
        lost += surface[p] == NOTHING && top + i < high && left + j < wide;
        surface[p] = !is_found ? NAN : contact[p] != 0 ? window.moved[p] - surface[p] : 0;
    }
    for (int p = 3 * size + item; p < PLANES * size; p += ITEMS) sheet[p] = 0;
    BARRIER;
    Box box = box_of(&window, contact);
    // Other maps are only needed near the contact.
    const int more = MARGIN + GREATER(box.bottom - box.top, box.right - box.left) / SHARE;
    const Box near = {top + GREATER(box.top - more, 0), LESSER(top + LESSER(box.bottom + more, rows), high),
                      left + GREATER(box.left - more, 0), LESSER(left + LESSER(box.right + more, columns), wide)};
    __global float *first = sheet + (near.top - top) * columns + near.left - left;
    if (sigma_kinds > 0) average(map_columns, 1, true, near, sigma, strip, columns, size, first + 3 * size);
    if (displacement_kinds > 0)
        average(map_columns, 2, false, near, displacement, strip, columns, size, first + 4 * size);
    if (displacement_sigma_kinds > 0)
        average(map_columns, displacement_sigma_kinds, true, near, displacement_sigma, strip, columns, size, first + 6 * size);
    if (displacement_sigma_kinds == 1)
        average(map_columns, 1, true, near, displacement_sigma, strip, columns, size, first + 7 * size);
    BARRIER;
    sum_up(&window, lost, loads, sheet, strip, sheet + PLANES * size);
}

// The strains that move a contact by given forms, by a work-group for each form.
__kernel GROUP_SIZE void contact_load(
    const int count, const int parts, const int rows, const int columns, const int reach, const float tolerance,
    const float lift, MAP basis, MAP across, MAP weights, MAP inverse, MAP contact, MAP forms, __global float *work,
    __global float *strains)
{
    __local float room[ITEMS];
    const int item = get_local_id(0), number = get_group_id(0), size = rows * columns;
    if (number >= count) return;
    const Window window = window_of(parts, rows, columns, reach, lift, basis, across, weights, inverse, work, room);
    __global float *strain = strains + number * parts * size;
    for (int p = item; p < parts * size; p += ITEMS) strain[p] *= contact[IN_PLANE(p)];
    BARRIER;
    const Box box = box_of(&window, contact);
    displace(&window, box, box, strain, window.moved);
    if (solve(&window, box, box, tolerance, forms + number * parts * size, contact, strain)) return;
    for (int p = item; p < parts * size; p += ITEMS) strain[p] = NAN;
}
