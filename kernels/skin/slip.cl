// Slip of windows of the skin, by how far each is displaced in a frame. Specification: slip.py.
//
// GROUP  items of the one work-group; 1 on a CPU

#pragma OPENCL FP_CONTRACT OFF

#include "common.clh"

#define INLINE static inline __attribute__((always_inline))

#define LEARN 1
#define MEASURE 2
#define FIND_SLIP 4

#define TOUCHED 1
#define PARTIAL 2
#define FOLLOWED 4
#define SETTLED 8
#define SLIPPED 16
#define EXCEEDED 32
#define SEEN 64

#define AFFINE 6
#define LEARNED 0
#define FIXED 1
#define DRIFT 3
#define TURNED 4
#define FLAGS 5
#define FITTED 6
#define ONSET 7
#define LAST 8

#define UNKNOWN 0
#define SLIPS 1
#define STICKS 2
#define NO_CONTACT 3
#define NO_TEXTURE 4

#define USED 7  // of the scratch: 1 if the window is compared with the motion, 2 if it also sticks
#define FITS 8
#define CHI_SQUARE 9
#define VARIANCE 10  // with everything that adds to the noise

#define NUMBERS 20
#define SUMS 8

#define MAX_CHANGE 0.5f
#define MIN_CONTRAST 0.5f
#define MIN_STEP 0.1f
#define MEMORY 64
#define FIRST 4
#define USUAL 1.5f
#define OUTLIER 9.0f
#define KINK 9.0f
#define CORRELATED_SAMPLES 4
#define LAPLACIAN_NOISE 0.13888889f
#define FEWEST 4
#define ROUNDS 2
#define CLOSE 9.0f
#define FAR 20.0f

#define IS_FINITE(x) ((x) - (x) == 0)
#define STATE(k) as_float(state[(k) * nodes + node])
#define SET_STATE(k, value) state[(k) * nodes + node] = as_int(value)
#define ANSWER(k) answer[(k) * nodes + node]
#define KNOWN(k) known[(k) * nodes + node]
#define SCRATCH(k) scratch[(k) * nodes + node]
#define IS_FOUND (SCRATCH(0) == SCRATCH(0))
#define CONVERGED (ANSWER(AFFINE + 2) < MAX_CHANGE && ANSWER(AFFINE) > MIN_CONTRAST)
#define EACH_WINDOW                                                                                                \
    for (int window = item, node; window < windows                                                                 \
             && (node = (top + window / wide) * columns + left + window % wide, 1); window += ITEMS)
#define NODE_AT(i, j) ((top + (i)) * columns + left + (j))

// Sums over the items of the group; smallest numbers if ``least``.
INLINE void combine(float *numbers, const int count, const int least, const int item, OUT sums)
{
    for (int i = 0; i < count; ++i) sums[item * SUMS + i] = numbers[i];
    BARRIER;
    for (int other = 0; other < ITEMS; ++other)
        for (int i = 0; i < count; ++i) {
            const float number = sums[other * SUMS + i];
            numbers[i] = other == 0 ? number : least ? LESSER(numbers[i], number) : numbers[i] + number;
        }
    BARRIER;
}

// The sum of the second differences along both axes, each at the nearest place that has both neighbours.
INLINE float laplacian(
    const int plane, const int i, const int j, const int high, const int wide, const int apart, const int top,
    const int left, const int columns, const int nodes, __global const float *scratch)
{
    __global const float *values = scratch + plane * nodes;
    float sum = 0;
    if (high > 2 * apart) {
        const int middle = LIMITED(i, apart, high - 1 - apart);
        sum += values[NODE_AT(middle - apart, j)] + values[NODE_AT(middle + apart, j)] - 2 * values[NODE_AT(middle, j)];
    }
    if (wide > 2 * apart) {
        const int middle = LIMITED(j, apart, wide - 1 - apart);
        sum += values[NODE_AT(i, middle - apart)] + values[NODE_AT(i, middle + apart)] - 2 * values[NODE_AT(i, middle)];
    }
    return sum;
}

__kernel GROUP_SIZE void slip_windows(
    const int rows, const int columns, const int top, const int bottom, const int left, const int right,
    const int work, const int least, const int frame, const int since_key, const int started, const int apart,
    const float bend_scale, const float chance, const float4 grid, const float2 size, MAP answer, MAP known,
    OUT field, __global int *restrict state, OUT scratch, OUT sums, __global int *restrict found)
{
    const int item = get_local_id(0), nodes = rows * columns, wide = right - left, high = bottom - top;
    const int windows = wide * high, at_rest = since_key == 0;
    float total[SUMS];

    total[0] = 0;
    if (!at_rest) EACH_WINDOW total[0] += CONVERGED;
    combine(total, 1, 0, item, sums);
    if (item == 0) found[0] = total[0];
    if (total[0] < least) return;

    if (work & LEARN) {
        const float share = 1.0f / LESSER(since_key, MEMORY);
        EACH_WINDOW {
            const float variance = ANSWER(AFFINE + 1), learned = STATE(LEARNED);
            const int usual = since_key < FIRST ? IS_FINITE(variance) : variance < USUAL * learned;
            const float mean = usual ? learned + (variance - learned) * share : learned;
            SET_STATE(LEARNED, mean == mean ? mean : variance);
        }
        // The next start: the mean step is added, as a window's own one has noise, unless it differs much.
        total[0] = total[1] = 0;
        EACH_WINDOW
            for (int k = 0; k < AFFINE; ++k) {
                const float value = CONVERGED ? ANSWER(k) : field[k * nodes + node], step = value - STATE(LAST + k);
                field[k * nodes + node] = k < 2 ? step : value;
                SET_STATE(LAST + k, value);
                if (k < 2) total[k] += step;
            }
        combine(total, 2, 0, item, sums);
        const float mean[2] = {total[0] / windows, total[1] / windows};
        for (int k = 0; k < 4; ++k) total[k] = INFINITY;
        EACH_WINDOW
            for (int k = 0; k < 2; ++k) {
                const float step = field[k * nodes + node], differs = step - mean[k];
                const float start = STATE(LAST + k) + (differs > MIN_STEP || differs < -MIN_STEP ? step : mean[k]);
                field[k * nodes + node] = start;
                total[k] = LESSER(total[k], start);
                total[2 + k] = LESSER(total[2 + k], -start);
            }
        combine(total, 4, 1, item, sums);
        // Windows outside of the part start like the nearest ones in it.
        for (int node = item; node < nodes; node += ITEMS) {
            const int i = LIMITED(node / columns, top, bottom - 1), j = LIMITED(node % columns, left, right - 1);
            if (i * columns + j == node) continue;
            for (int k = 0; k < AFFINE; ++k) {
                field[k * nodes + node] = field[k * nodes + i * columns + j];
                state[(LAST + k) * nodes + node] = state[(LAST + k) * nodes + i * columns + j];
            }
        }
        if (item == 0)
            for (int k = 0; k < 4; ++k) found[1 + k] = as_int(k < 2 ? total[k] : -total[k]);
    }

    if (work & MEASURE) {
        EACH_WINDOW {
            const float variance = ANSWER(AFFINE + 1), ratio = variance / KNOWN(0) - chance;
            const int follows = (state[FLAGS * nodes + node] & FOLLOWED) != 0;
            const int is_found = follows && (at_rest || (CONVERGED && variance < OUTLIER * KNOWN(0)));
            SCRATCH(0) = !is_found ? NAN : at_rest ? 0 : ANSWER(0) * size.x;
            SCRATCH(1) = !is_found ? NAN : at_rest ? 0 : -ANSWER(1) * size.y;
            const float misfit = at_rest ? 0 : 1 + CORRELATED_SAMPLES * (ratio > 0 ? ratio : 0);
            for (int k = 0; k < 3; ++k) SCRATCH(2 + k) = KNOWN(1 + k) * misfit;
        }
        BARRIER;
        EACH_WINDOW
            for (int k = 0; k < 2; ++k)
                SCRATCH(7 + k) = laplacian(
                    k, window / wide, window % wide, high, wide, apart, top, left, columns, nodes, scratch);
        BARRIER;
        EACH_WINDOW {
            const int i = window / wide, j = window % wide;
            int nearest = node, closest = IS_FINITE(SCRATCH(7) + SCRATCH(8)) ? 0 : high * high + wide * wide;
            for (int reach = 1; reach * reach <= closest && reach < GREATER(high, wide) && IS_FOUND; ++reach)
                for (int a = GREATER(i - reach, 0); a <= LESSER(i + reach, high - 1); ++a) {
                    const int edge = a == i - reach || a == i + reach;
                    for (int b = j - reach; b <= j + reach; b += edge ? 1 : 2 * reach) {
                        const int other = NODE_AT(a, b), square = (a - i) * (a - i) + (b - j) * (b - j);
                        if (b < 0 || b >= wide || square > closest || (square == closest && other > nearest)) continue;
                        if (!IS_FINITE(scratch[7 * nodes + other] + scratch[8 * nodes + other])) continue;
                        closest = square;
                        nearest = other;
                    }
                }
            for (int k = 0; k < 2; ++k) {
                const float bias = bend_scale * scratch[(7 + k) * nodes + nearest];
                const float square = bias * bias - LAPLACIAN_NOISE * KNOWN(1 + k);
                const float kink = state[FLAGS * nodes + node] & PARTIAL ? KINK : 1.0f;
                SCRATCH(5 + k) = !at_rest && square > 0 ? kink * square : 0;
            }
        }
        BARRIER;
    }

    if (!(work & FIND_SLIP)) return;
    int has_motion = 0, has_started = started;
    float about_x = 0, about_y = 0, moved_x = 0, moved_y = 0, sine = 0, less = 0, variance = 0, angle_variance = 0;
    EACH_WINDOW {
        const int flags = state[FLAGS * nodes + node], partial = flags & PARTIAL || !(flags & SETTLED);
        const int used = IS_FOUND && flags & TOUCHED && IS_FINITE(STATE(FIXED));
        const int sticks = used && !partial && !(flags & SLIPPED);
        SCRATCH(USED) = used + sticks;
        SCRATCH(FITS) = sticks;
        SCRATCH(CHI_SQUARE) = 0;
        for (int k = 0; k < 3; ++k) {
            // Skin that sticks does not bend.
            const float more = k < 2 ? (partial ? SCRATCH(5 + k) : 0.0f) + STATE(DRIFT) : 0.0f;
            SCRATCH(VARIANCE + k) = SCRATCH(2 + k) + KNOWN(6 + k) + more;
        }
    }
    BARRIER;  // before the branches: PoCL skips what comes before the first barrier of the second one
    if (!started) {
        total[0] = 0;
        EACH_WINDOW {
            const int flags = state[FLAGS * nodes + node], sticks = IS_FOUND && (flags & TOUCHED);
            const int settles = sticks && !(flags & PARTIAL);
            SET_STATE(FIXED, sticks ? SCRATCH(0) : NAN);
            SET_STATE(FIXED + 1, sticks ? SCRATCH(1) : NAN);
            SET_STATE(DRIFT, 0.0f);
            SET_STATE(TURNED, 0.0f);
            state[FLAGS * nodes + node] = (flags & ~SETTLED) | (settles ? SETTLED : 0);
            state[FITTED * nodes + node] = frame;
            total[0] += settles;
        }
        combine(total, 1, 0, item, sums);
        has_motion = has_started = total[0] >= FEWEST;
    } else {
        for (int round = 0; round < ROUNDS; ++round) {
            for (int k = 0; k < 7; ++k) total[k] = 0;
            EACH_WINDOW if (SCRATCH(FITS) > 0) {
                const float weight = 2 / (SCRATCH(VARIANCE) + SCRATCH(VARIANCE + 1));
                const float fixed_x = STATE(FIXED), fixed_y = STATE(FIXED + 1);
                total[0] += 1;
                total[1] += weight;
                total[2] += weight * (grid.x + node % columns * grid.z + fixed_x);
                total[3] += weight * (grid.y - node / columns * grid.w + fixed_y);
                total[4] += weight * (SCRATCH(0) - fixed_x);
                total[5] += weight * (SCRATCH(1) - fixed_y);
                total[6] += weight * STATE(DRIFT);
            }
            combine(total, 7, 0, item, sums);
            has_motion = total[0] >= FEWEST;
            if (!has_motion) break;
            const float weights = total[1];
            about_x = total[2] / weights;
            about_y = total[3] / weights;
            moved_x = total[4] / weights;
            moved_y = total[5] / weights;
            variance = (1 + total[6]) / weights;
            for (int k = 0; k < 4; ++k) total[k] = 0;
            EACH_WINDOW if (SCRATCH(FITS) > 0) {
                const float weight = 2 / (SCRATCH(VARIANCE) + SCRATCH(VARIANCE + 1));
                const float fixed_x = STATE(FIXED), fixed_y = STATE(FIXED + 1);
                const float x = grid.x + node % columns * grid.z + fixed_x - about_x;
                const float y = grid.y - node / columns * grid.w + fixed_y - about_y;
                const float to_x = SCRATCH(0) - fixed_x - moved_x, to_y = SCRATCH(1) - fixed_y - moved_y;
                const float moment = weight * (x * x + y * y);
                total[0] += moment;
                total[1] += moment * STATE(TURNED);
                total[2] += weight * (x * to_x + y * to_y);
                total[3] += weight * (x * to_y - y * to_x);
            }
            combine(total, 4, 0, item, sums);
            const float along = total[0] + total[2], across = total[3], square = along * along + across * across;
            const float per_length = square > 0 ? inverse_root(square) : 0, cosine = along * per_length;
            sine = across * per_length;
            less = square > 0 ? cosine > 0 ? -sine * sine / (1 + cosine) : cosine - 1 : 0;  // cosine less 1
            angle_variance = total[0] > 0 ? (1 + total[1]) / total[0] : INFINITY;
            total[0] = 0;
            EACH_WINDOW if (SCRATCH(USED) > 0) {
                const float fixed_x = STATE(FIXED), fixed_y = STATE(FIXED + 1);
                const float x = grid.x + node % columns * grid.z + fixed_x - about_x;
                const float y = grid.y - node / columns * grid.w + fixed_y - about_y;
                const float left_x = SCRATCH(0) - fixed_x - moved_x - (less * x - sine * y);
                const float left_y = SCRATCH(1) - fixed_y - moved_y - (less * y + sine * x);
                // What takes part in the fit is closer to it.
                const float spread = variance + (x * x + y * y) * angle_variance;
                const float more = SCRATCH(FITS) > 0 ? -spread : spread, xy = SCRATCH(VARIANCE + 2);
                const float xx = SCRATCH(VARIANCE) + more, yy = SCRATCH(VARIANCE + 1) + more;
                const float chi_square = (yy * left_x * left_x - 2 * xy * left_x * left_y + xx * left_y * left_y)
                    / (xx * yy - xy * xy);
                const float fits = SCRATCH(USED) == 2 && chi_square < CLOSE;
                total[0] += fits != SCRATCH(FITS);
                SCRATCH(CHI_SQUARE) = chi_square;
                SCRATCH(FITS) = fits;
            }
            combine(total, 1, 0, item, sums);
            if (total[0] == 0) break;
        }
        if (has_motion) {
            // A window that departs once starts to slip if one of its neighbours does, too.
            EACH_WINDOW
                SCRATCH(FITS) = SCRATCH(USED) > 0 && SCRATCH(CHI_SQUARE) > FAR && !(state[FLAGS * nodes + node] & SLIPPED);
            BARRIER;
            EACH_WINDOW {
                const int i = window / wide, j = window % wide, used = SCRATCH(USED) > 0;
                const int exceeds = used && SCRATCH(CHI_SQUARE) > FAR;
                int flags = state[FLAGS * nodes + node];
                if (SCRATCH(FITS) > 0) {
                    int departs = 0;
                    for (int a = GREATER(i - 1, 0); a <= LESSER(i + 1, high - 1); ++a)
                        for (int b = GREATER(j - 1, 0); b <= LESSER(j + 1, wide - 1); ++b)
                            departs += scratch[FITS * nodes + NODE_AT(a, b)] > 0;
                    if (flags & EXCEEDED || departs > 1) {
                        state[ONSET * nodes + node] = state[FITTED * nodes + node] + 1;
                        flags |= SLIPPED;
                    }
                }
                flags = (flags & ~EXCEEDED) | (exceeds ? EXCEEDED : 0);
                if (used && SCRATCH(CHI_SQUARE) < CLOSE) state[FITTED * nodes + node] = frame;
                const int partial = flags & PARTIAL;
                const int is_known = flags & (SETTLED | SLIPPED) || (IS_FINITE(STATE(FIXED)) && partial);
                if (IS_FOUND && flags & TOUCHED && !is_known) {
                    const float x = grid.x + node % columns * grid.z - about_x + SCRATCH(0) - moved_x;
                    const float y = grid.y - node / columns * grid.w - about_y + SCRATCH(1) - moved_y;
                    const float bent = partial ? (SCRATCH(5) + SCRATCH(6)) / 2 : 0;
                    SET_STATE(FIXED, SCRATCH(0) - moved_x + less * x + sine * y);
                    SET_STATE(FIXED + 1, SCRATCH(1) - moved_y + less * y - sine * x);
                    SET_STATE(DRIFT, variance + (x * x + y * y) * angle_variance + bent);
                    SET_STATE(TURNED, angle_variance);
                    state[FITTED * nodes + node] = frame;
                    if (!partial) flags |= SETTLED;
                }
                state[FLAGS * nodes + node] = flags;
            }
        }
    }
    BARRIER;

    __global int *displacement = found + NUMBERS, *sigma = displacement + 2 * nodes, *covariance = sigma + 2 * nodes;
    __global int *status = covariance + 3 * nodes, *onset = status + nodes;
    for (int k = 0; k < 4; ++k) total[k] = 0;
    for (int node = item; node < nodes; node += ITEMS) {
        const int i = node / columns, j = node % columns, flags = state[FLAGS * nodes + node];
        const int inside = i >= top && i < bottom && j >= left && j < right, is_found = inside && IS_FOUND;
        const int touched = inside && flags & TOUCHED, counted = touched && flags & FOLLOWED;
        const int seen = flags & SEEN || (is_found && !at_rest);
        for (int k = 0; k < 2; ++k) {
            const float square = SCRATCH(2 + k) + KNOWN(6 + k) + SCRATCH(5 + k);
            const float moved = SCRATCH(k) + KNOWN(4 + k);
            const int is_known = is_found && moved == moved;
            displacement[2 * node + k] = as_int(is_found ? moved : NAN);
            sigma[2 * node + k] = as_int(is_known ? root(square) : NAN);
            covariance[3 * node + k] = as_int(is_known ? square : NAN);
            if (k == 1) covariance[3 * node + 2] = as_int(is_known ? SCRATCH(4) + KNOWN(8) : NAN);
        }
        status[node] = !touched ? NO_CONTACT : !counted ? NO_TEXTURE : !is_found || !IS_FINITE(STATE(FIXED)) ? UNKNOWN
            : flags & SLIPPED ? SLIPS : STICKS;
        onset[node] = state[ONSET * nodes + node];
        state[FLAGS * nodes + node] = seen ? flags | SEEN : flags;
        total[0] += counted;
        total[1] += counted && flags & SLIPPED;
        total[2] += seen && touched;
        total[3] += is_found && touched;
    }
    combine(total, 4, 0, item, sums);
    if (item != 0) return;
    for (int k = 0; k < 4; ++k) found[5 + k] = total[k];
    found[9] = has_motion;
    found[10] = has_started;
    const float motion[8] = {about_x, about_y, moved_x, moved_y, sine, less, variance, angle_variance};
    for (int k = 0; k < 8; ++k) found[11 + k] = has_motion ? as_int(motion[k]) : 0;
}
