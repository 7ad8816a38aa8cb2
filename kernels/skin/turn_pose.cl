// Normal equations of a rigid motion from a turn to a single frame. Specification: turn_pose.py.
//
// TILE     1 on a GPU; otherwise an item processes a row of LANES pixels at once
// BESIDE   1 if the Jacobian by the gradient of the frame is also computed

#include "common.clh"

#include "pose.clh"

#define SUMS (BESIDE ? 81 : 39)
#define NUMBERS 8  // of a record
#define CLEAR 10.0f

// The angle with a sine and a cosine, in proportion, above 0.
F angle_of(const F sine, const F cosine)
{
    const I steep = sine > cosine;
    const F a = steep ? cosine / sine : sine / cosine, b = a * a;
    const F low = a * ARCTANGENT_RATIO(b);
    return steep ? 1.57079633f - low : low;
}

// Weights of the cubic interpolation between four pixels in line, and their derivatives.
#define CUBIC(t)                                                                                                 \
    {                                                                                                            \
        0.5f * (t) * ((t) * (2.0f - (t)) - 1.0f), 0.5f * ((t) * (t) * (3.0f * (t) - 5.0f) + 2.0f),                  \
            0.5f * (t) * ((t) * (4.0f - 3.0f * (t)) + 1.0f), 0.5f * (t) * (t) * ((t) - 1.0f)                        \
    }
#define CUBIC_CHANGE(t)                                                                                          \
    {                                                                                                            \
        0.5f * ((t) * (4.0f - 3.0f * (t)) - 1.0f), 0.5f * (t) * (9.0f * (t) - 10.0f),                               \
            0.5f * ((t) * (8.0f - 9.0f * (t)) + 1.0f), 0.5f * (t) * (3.0f * (t) - 2.0f)                             \
    }
#define SQUARES(w) ((w)[0] * (w)[0] + (w)[1] * (w)[1] + (w)[2] * (w)[2] + (w)[3] * (w)[3])

// The Jacobian with the gradient of the zenith along x and y of the frame; the change along z is 0.
#define JACOBIAN(weight, turned, by_x, by_y)                                                                       \
    {                                                                                                            \
        (weight) * (turned##_x - (by_y) * arm_z), (weight) * (turned##_y + (by_x) * arm_z),                         \
            (weight) * (turned##_z + (by_y) * arm_x - (by_x) * arm_y), (weight) * (by_x), (weight) * (by_y)         \
    }

// For each block of the turn's pixels: the SUMS sums described in turn_pose.py.
__kernel void turn_pose_equations(
    const int rows, const int columns, const int other_rows, const int other_columns, const int step, const float base,
    MAP turn, MAP zeniths, MAP pose, OUT sums)
{
    const int side = BLOCK * step, across = (columns + side - 1) / side, blocks = (rows + side - 1) / side * across;
    const int block = get_global_id(0), top = block / across * side, begin = block % across * side;
    if (block >= blocks) return;
    float r[9];
    UNROLL for (int i = 0; i < 9; ++i) r[i] = pose[i];
    const float3 shift = vload3(3, pose), centre = vload3(4, pose), axis = vload3(8, pose);
    const float x0 = pose[15], y0 = pose[16], step_x = pose[17], step_y = pose[18], flat_limit = pose[23];
    const float other_x = pose[19], other_y = pose[20], wide = pose[21], high = pose[22], frames = pose[27], limit = pose[28], other_frame = pose[29];
    const float east_x = 1.0f / wide, south_y = 1.0f / high;
    // The axis in the turn's coordinates.
    const float axis_x = axis.x * r[0] + axis.y * r[3] + axis.z * r[6], axis_y = axis.x * r[1] + axis.y * r[4] + axis.z * r[7],
                axis_z = axis.x * r[2] + axis.y * r[5] + axis.z * r[8];
    F total[SUMS];
    UNROLL for (int i = 0; i < SUMS; ++i) total[i] = 0.0f;
    for (int row = top; row < LESSER(top + side, rows); row += step)
        for (int column = begin; column < LESSER(begin + side, columns); column += LANES * step) {
            float records[NUMBERS][LANES], near[4][4][LANES];
            UNROLL for (int i = 0; i < LANES; ++i)
                UNROLL for (int k = 0; k < NUMBERS; ++k)
                    records[k][i] = turn[NUMBERS * (row * columns + LESSER(column + i * step, columns - 1)) + k];
            const I number = column + step * ORDER;
            const F first = KEPT(records[0]), z = KEPT(records[3]);
            const F x = x0 + CONVERT(number, F) * step_x;
            const float y = y0 - row * step_y;
            const F place_x = r[0] * x + r[1] * y + r[2] * z + shift.x, place_y = r[3] * x + r[4] * y + r[5] * z + shift.y;
            const F place_z = r[6] * x + r[7] * y + r[8] * z + shift.z;
            F to_right = (place_x - other_x) * east_x, to_below = (other_y - place_y) * south_y;
            const I inside = (number < columns) & (first == first) & (to_right >= 1.0f) & (to_right < other_columns - 2)
                & (to_below >= 1.0f) & (to_below < other_rows - 2);
            if (!any_of(inside)) continue;
            to_right = inside ? to_right : (F)1.0f;
            to_below = inside ? to_below : (F)1.0f;
            const I west = CONVERT(to_right, I), north = CONVERT(to_below, I);
            const F u = to_right - CONVERT(west, F), v = to_below - CONVERT(north, F);
            const F across[4] = CUBIC(u), along[4] = CUBIC(v);
            int places[LANES];
            *(Places *)places = (north - 1) * other_columns + west - 1;
            UNROLL for (int i = 0; i < LANES; ++i)
                UNROLL for (int k = 0; k < 4; ++k)
                    UNROLL for (int l = 0; l < 4; ++l) near[k][l][i] = zeniths[places[i] + k * other_columns + l];
            F seen = 0.0f;
            UNROLL for (int k = 0; k < 4; ++k)
                seen += along[k] * (across[0] * KEPT(near[k][0]) + across[1] * KEPT(near[k][1])
                                    + across[2] * KEPT(near[k][2]) + across[3] * KEPT(near[k][3]));
            const I known = inside & (seen == seen);
            if (!any_of(known)) continue;

            const F zero = 0.0f, one = 1.0f;
            const F n_x = known ? first : zero, n_y = known ? KEPT(records[1]) : zero, square = known ? KEPT(records[2]) : one;
            const F xx = known ? KEPT(records[5]) : zero, xy = known ? KEPT(records[6]) : zero, yy = known ? KEPT(records[7]) : zero;
            const F flat = n_x * n_x + n_y * n_y, n_z = roots(GREATER(1.0f - flat, (F)1e-6f)), over_z = 1.0f / n_z;
            const F turned_n_x = r[0] * n_x + r[1] * n_y + r[2] * n_z, turned_n_y = r[3] * n_x + r[4] * n_y + r[5] * n_z;
            const F turned_n_z = r[6] * n_x + r[7] * n_y + r[8] * n_z;
            const F cross_x = turned_n_y * axis.z - turned_n_z * axis.y, cross_y = turned_n_z * axis.x - turned_n_x * axis.z;
            const F cross_z = turned_n_x * axis.y - turned_n_y * axis.x;
            const F sine = roots(cross_x * cross_x + cross_y * cross_y + cross_z * cross_z);
            const F cosine = axis_x * n_x + axis_y * n_y + axis_z * n_z;
            const F outside = GREATER(flat, (F)flat_limit), per_outside = 1.0f / outside, fraction = 0.5f * flat_limit * per_outside;
            const F uncertain = square * (1.0f - fraction), least = CLEAR * uncertain;
            const I clear = known & (sine * sine > least) & (flat > least) & (cosine > 0.0f) & (square < VAGUE);
            const F per_sine = 1.0f / (clear ? sine : one), zenith = angle_of(clear ? sine : zero, clear ? cosine : one);

            const F lean = per_sine * (n_z * (axis_x * n_x + axis_y * n_y) - axis_z * flat);
            const F weight_square = SQUARES(across) * SQUARES(along);
            const F variance = uncertain
                + square * ((2.0f * fraction - 1.0f) * lean * lean * per_outside + weight_square * frames * fraction);
            const F bend = 0.5f * uncertain * (per_sine - inverse_roots(clear ? flat : one));
            const F certainty = inverse_roots(GREATER(variance, (F)1e-20f)), difference = known ? certainty * (seen - zenith + bend) : zero;
            const I kept = clear & (difference * difference <= limit);
            const F sure = kept ? certainty : zero, residual = kept ? difference : zero;

            // Change of the zenith along x and y of the turn, then of the frame.
            const F along_x = n_x * xx + n_y * xy, along_y = n_x * xy + n_y * yy, by_angle = -per_sine * n_z;
            const F across_n = axis_x * n_x + axis_y * n_y + axis_z * n_z;
            const F change_x = by_angle * (along_x * across_n - axis_x * xx - axis_y * xy);
            const F change_y = by_angle * (along_y * across_n - axis_x * xy - axis_y * yy);
            const F slope_x = n_x * over_z, slope_y = n_y * over_z;
            const F a = r[0] - r[2] * slope_x, c = r[3] - r[5] * slope_x, b = r[1] - r[2] * slope_y, d = r[4] - r[5] * slope_y;
            const F per_area = 1.0f / (a * d - b * c);
            const F by_x = per_area * (d * change_x - c * change_y), by_y = per_area * (a * change_y - b * change_x);
            const F turned_x = per_sine * cross_x, turned_y = per_sine * cross_y, turned_z = per_sine * cross_z;
            const F arm_x = known ? place_x - centre.x : zero, arm_y = known ? place_y - centre.y : zero, arm_z = known ? place_z - centre.z : zero;
            const F light = sure * (base + zenith), per_flat = inverse_roots(clear ? flat : one);
            const F tangent_x = -n_y * per_flat, tangent_y = n_x * per_flat, axis_across = per_sine * (axis_x * tangent_x + axis_y * tangent_y);
            const F t_x = r[0] * tangent_x + r[1] * tangent_y, t_y = r[3] * tangent_x + r[4] * tangent_y, t_z = r[6] * tangent_x + r[7] * tangent_y;
            const F both = other_frame * uncertain * per_sine * axis_across, both_cosine = both * cosine;
            const F both_x = both_cosine * (axis_across * change_x - n_z * (tangent_x * xx + tangent_y * xy));
            const F both_y = both_cosine * (axis_across * change_y - n_z * (tangent_x * xy + tangent_y * yy));
            const F both_turned_x = both * (t_y * axis.z - t_z * axis.y) + both_cosine * axis_across * turned_x;
            const F both_turned_y = both * (t_z * axis.x - t_x * axis.z) + both_cosine * axis_across * turned_y;
            const F both_turned_z = both * (t_x * axis.y - t_y * axis.x) + both_cosine * axis_across * turned_z;
            const F both_by_x = per_area * (d * both_x - c * both_y), both_by_y = per_area * (a * both_y - b * both_x);
            const F common[5] = JACOBIAN(sure * sure, both_turned, both_by_x, both_by_y);
            const F j[5] = JACOBIAN(sure, turned, by_x, by_y);
            UNROLL for (int i = 0; i < 5; ++i) {
                UNROLL for (int k = 0; k < 5; ++k)
                    if (k >= i) total[UPPER(i, k)] += j[i] * j[k];
                total[21 + i] += j[i] * residual - common[i];
                total[31 + i] += light * j[i];
            }
            total[27] += residual * residual;
            total[28] += kept ? one : zero;
            total[30] += kept ? one : zero;
            total[37] += light * light;
            total[38] += light * residual;
#if BESIDE
            const F across_change[4] = CUBIC_CHANGE(u), along_change[4] = CUBIC_CHANGE(v);
            F east = 0.0f, south = 0.0f;
            UNROLL for (int k = 0; k < 4; ++k)
                UNROLL for (int l = 0; l < 4; ++l) {
                    east += along[k] * across_change[l] * KEPT(near[k][l]);
                    south += along_change[k] * across[l] * KEPT(near[k][l]);
                }
            const F seen_x = known ? east_x * east : zero, seen_y = known ? -south_y * south : zero;
            const F beside[5] = JACOBIAN(sure, turned, seen_x, seen_y);
            UNROLL for (int i = 0; i < 5; ++i) {
                UNROLL for (int k = 0; k < 5; ++k) total[39 + 6 * i + k] += j[i] * beside[k];
                total[75 + i] += light * beside[i];
            }
#endif
        }
    OUT out = sums + block * SUMS;
    UNROLL for (int i = 0; i < SUMS; ++i) out[i] = sum_over_lanes(total[i]);
}
