// Normal equations of a rigid motion between two maps. Specification: pose.py.
//
// TILE     1 on a GPU; otherwise an item processes a row of LANES pixels at once
// BESIDE   1 if the Jacobian by the first map's own curvature is also computed

#include "common.clh"

#if TILE > 1
#define LANES 8  // pixels of a row of a block
#else
#define LANES 1
#endif
#include "lanes.clh"

#define UNROLL _Pragma("unroll")

#define BLOCK 8
#define SUMS (BESIDE ? 67 : 31)
#define POSE 26
#define NEAR 1e20f
#define VAGUE 100.0f

#define LOAD(map, p) (*(__global const Loose *)((map) + 8 * (p)))
#define KEEP(values, memory) (*(Lanes *)(memory) = (values))
#define KEPT(memory) (*(const Lanes *)(memory))
typedef float8 __attribute__((aligned(4))) Loose;  // unaligned
typedef F __attribute__((aligned(4))) Lanes;
typedef I __attribute__((aligned(4))) Places;

typedef struct { F x, y, z; } Vector;
typedef struct { F xx, xy, yy; } Symmetric;  // covariance of a normal's x and y, or second derivatives
typedef struct { F x, y, square, z, variance, xx, xy, yy; } Record;

#if LANES > 1
// The records of a row of pixels, number by number.
#define LOW(a, b) (F)(a.s0, b.s0, a.s1, b.s1, a.s4, b.s4, a.s5, b.s5)
#define HIGH(a, b) (F)(a.s2, b.s2, a.s3, b.s3, a.s6, b.s6, a.s7, b.s7)
#define LOW_PAIRS(a, b) (F)(a.s01, b.s01, a.s45, b.s45)
#define HIGH_PAIRS(a, b) (F)(a.s23, b.s23, a.s67, b.s67)
Record transposed(const float8 *r)
{
    const F a = LOW(r[0], r[1]), b = HIGH(r[0], r[1]), c = LOW(r[2], r[3]), d = HIGH(r[2], r[3]);
    const F e = LOW(r[4], r[5]), f = HIGH(r[4], r[5]), g = LOW(r[6], r[7]), h = HIGH(r[6], r[7]);
    const F i = LOW_PAIRS(a, c), j = HIGH_PAIRS(a, c), k = LOW_PAIRS(b, d), l = HIGH_PAIRS(b, d);
    const F m = LOW_PAIRS(e, g), n = HIGH_PAIRS(e, g), o = LOW_PAIRS(f, h), p = HIGH_PAIRS(f, h);
    return (Record){(F)(i.lo, m.lo), (F)(j.lo, n.lo), (F)(k.lo, o.lo), (F)(l.lo, p.lo),
                    (F)(i.hi, m.hi), (F)(j.hi, n.hi), (F)(k.hi, o.hi), (F)(l.hi, p.hi)};
}

#define NUMBERS (I)(0, 1, 2, 3, 4, 5, 6, 7)
#else
Record transposed(const float8 *r)
{
    return (Record){r->s0, r->s1, r->s2, r->s3, r->s4, r->s5, r->s6, r->s7};
}

#define NUMBERS 0
#endif

// Invalid pixels get weight 0 and finite values.
Record where(const I defined, const Record r)
{
    const F none = 0.0f;
    return (Record){defined ? r.x : none, defined ? r.y : none, defined ? r.square : (F)1.0f, defined ? r.z : none,
                    defined ? r.variance : none, defined ? r.xx : none, defined ? r.xy : none, defined ? r.yy : none};
}

Vector upright(const F x, const F y) { return (Vector){x, y, roots(GREATER(1.0f - x * x - y * y, (F)1e-6f))}; }

// Covariance of a normal after a rotation; u, v: its x and y then.
Symmetric variances(const Vector n, const float *turn, const F u, const F v, const F square, const float flat_limit)
{
    const F flat = n.x * n.x + n.y * n.y, outside = GREATER(flat, (F)flat_limit), per_outside = 1.0f / outside;
    const F fraction = 0.5f * flat_limit * per_outside, across = (1.0f - fraction) * square;
    const F more = (2.0f * fraction - 1.0f) * square * per_outside;
    const F a = n.z * (turn[0] * n.x + turn[1] * n.y) - turn[2] * flat;
    const F b = n.z * (turn[3] * n.x + turn[4] * n.y) - turn[5] * flat;
    return (Symmetric){across * (1.0f - u * u) + more * a * a, more * a * b - across * u * v,
                       across * (1.0f - v * v) + more * b * b};
}

Symmetric same_variances(const Vector n, const F square, const float flat_limit)
{
    const F flat = n.x * n.x + n.y * n.y, per_outside = 1.0f / GREATER(flat, (F)flat_limit);
    const F fraction = 0.5f * flat_limit * per_outside, across = (1.0f - fraction) * square;
    const F more = (2.0f * fraction - 1.0f) * square * per_outside * n.z * n.z - across;
    return (Symmetric){across + more * n.x * n.x, more * n.x * n.y, across + more * n.y * n.y};
}

// A second derivative of F = z - h(x, y) after a rotation.
#define SECOND(i, j)                                                                                              \
    -(h.xx * (turn[3 * i] * turn[3 * j]) + h.xy * (turn[3 * i] * turn[3 * j + 1] + turn[3 * i + 1] * turn[3 * j])   \
      + h.yy * (turn[3 * i + 1] * turn[3 * j + 1]))

Symmetric turn_curvature(const F z_before, const Symmetric h, const F over_z, const float *turn, const Vector n)
{
    const F p = -n.x * over_z, q = -n.y * over_z, scale = -z_before * over_z;
    const F xx = SECOND(0, 0), xy = SECOND(0, 1), yy = SECOND(1, 1), xz = SECOND(0, 2), yz = SECOND(1, 2), zz = SECOND(2, 2);
    return (Symmetric){scale * (xx + 2.0f * xz * p + zz * p * p), scale * (xy + xz * q + yz * p + zz * p * q),
                       scale * (yy + 2.0f * yz * q + zz * q * q)};
}

// Three rows of the Jacobian, six numbers each; the first two are whitened, and are 0 for a translation along
// z.
typedef struct { F x[5], y[5], z[6]; } Jacobian;
#define UPPER(i, k) ((i) * (11 - (i)) / 2 + (k))
#define PRODUCT(a, i, b, k) \
    (((i) < 5 && (k) < 5 ? (a).x[i] * (b).x[k] + (a).y[i] * (b).y[k] : 0.0f) + (a).z[i] * (b).z[k])

void jacobian(const Vector n, const Symmetric h, const F over_z, const Vector arm, const Vector lower,
              const F height_weight, Jacobian *rows)
{
    const F change_x[5] = {-h.xy * arm.z, h.xx * arm.z, h.xy * arm.x - h.xx * arm.y, h.xx, h.xy};
    const F change_y[5] = {-h.yy * arm.z, h.xy * arm.z, h.yy * arm.x - h.xy * arm.y, h.xy, h.yy};
    const F turn_x[5] = {0.0f, n.z, -n.y, 0.0f, 0.0f}, turn_y[5] = {-n.z, 0.0f, n.x, 0.0f, 0.0f};
    UNROLL for (int i = 0; i < 5; ++i) {
        const F along = n.x * change_x[i] + n.y * change_y[i];
        rows->x[i] = (turn_x[i] + n.z * (change_x[i] - n.x * along)) * lower.x;
        rows->y[i] = (turn_y[i] + n.z * (change_y[i] - n.y * along) - lower.y * rows->x[i]) * lower.z;
    }
    const F by = height_weight * over_z, by_x = by * n.x, by_y = by * n.y;
    rows->z[0] = height_weight * arm.y - by_y * arm.z;
    rows->z[1] = by_x * arm.z - height_weight * arm.x;
    rows->z[2] = by_y * arm.x - by_x * arm.y;
    rows->z[3] = by_x;
    rows->z[4] = by_y;
    rows->z[5] = height_weight;
}

// For each pose and each block of the first map's pixels: the SUMS sums described in pose.py.
__kernel void pose_equations(
    const int count, const int rows, const int columns, const int other_rows, const int other_columns, const int step,
    MAP first, MAP second, MAP poses, OUT sums)
{
    const int side = BLOCK * step, across = (columns + side - 1) / side, blocks = (rows + side - 1) / side * across;
    const int item = get_global_id(0), block = item % blocks;
    const int top = block / across * side, begin = block % across * side;
    if (item / blocks >= count) return;
    MAP pose = poses + item / blocks * POSE;
    float turn[9];
    UNROLL for (int i = 0; i < 9; ++i) turn[i] = pose[i];
    const float3 shift = vload3(3, pose), centre = vload3(4, pose);
    const float x0 = pose[15], y0 = pose[16], step_x = pose[17], step_y = pose[18], flat_limit = pose[23];
    const float other_x = pose[19], other_y = pose[20], wide = pose[21], high = pose[22], other_flat_limit = pose[24], limit = pose[25];
    const float east_x = 1.0f / wide, south_y = 1.0f / high;
    F total[SUMS];
    UNROLL for (int i = 0; i < SUMS; ++i) total[i] = 0.0f;
    for (int row = top; row < LESSER(top + side, rows); row += step)
        for (int column = begin; column < LESSER(begin + side, columns); column += LANES * step) {
            float8 records[LANES];
            UNROLL for (int i = 0; i < LANES; ++i)
                records[i] = LOAD(first, row * columns + LESSER(column + i * step, columns - 1));
            Record mine = transposed(records);
            const I number = column + step * NUMBERS;
            const F x = x0 + CONVERT(number, F) * step_x;
            const float y = y0 - row * step_y;
            const Vector place = {turn[0] * x + turn[1] * y + turn[2] * mine.z + shift.x,
                                  turn[3] * x + turn[4] * y + turn[5] * mine.z + shift.y,
                                  turn[6] * x + turn[7] * y + turn[8] * mine.z + shift.z};
            F to_right = (place.x - other_x) * east_x, to_below = (other_y - place.y) * south_y;
            const I inside = (number < columns) & (mine.x == mine.x) & (to_right >= 0.0f) & (to_right < other_columns - 1)
                & (to_below >= 0.0f) & (to_below < other_rows - 1);
            if (!any_of(inside)) continue;
            to_right = inside ? to_right : (F)0.0f;
            to_below = inside ? to_below : (F)0.0f;
            const I west = CONVERT(to_right, I), north = CONVERT(to_below, I);
            const F u = to_right - CONVERT(west, F), v = to_below - CONVERT(north, F);
            float us[LANES], vs[LANES], bents_x[LANES], bents_y[LANES];
            int corners[LANES];
            KEEP(u, us);
            KEEP(v, vs);
            *(Places *)corners = north * other_columns + west;
            UNROLL for (int i = 0; i < LANES; ++i) {
                const int at = corners[i], below = at + other_columns;
                const float8 nw = LOAD(second, at), ne = LOAD(second, at + 1), sw = LOAD(second, below), se = LOAD(second, below + 1);
                const float8 upper = (1.0f - us[i]) * nw + us[i] * ne, lower = (1.0f - us[i]) * sw + us[i] * se;
                const float8 change_x = (1.0f - vs[i]) * (nw - ne) + vs[i] * (sw - se), change_y = upper - lower;
                records[i] = (1.0f - vs[i]) * upper + vs[i] * lower;
                bents_x[i] = change_x.s0;
                bents_y[i] = change_y.s1;
            }
            Record theirs = transposed(records);
            const I defined = inside & (theirs.x == theirs.x);
            if (!any_of(defined)) continue;
            mine = where(defined, mine);
            theirs = where(defined, theirs);

            const F fraction = (u * u + (1.0f - u) * (1.0f - u)) * (v * v + (1.0f - v) * (1.0f - v));
            const Vector n = upright(theirs.x, theirs.y), before = upright(mine.x, mine.y);
            const Vector arm = {defined ? place.x - centre.x : (F)0.0f, defined ? place.y - centre.y : (F)0.0f,
                                defined ? place.z - centre.z : (F)0.0f};
            const F bent = u * (1.0f - u) * wide * KEPT(bents_x) - v * (1.0f - v) * high * KEPT(bents_y);
            const F over_z = 1.0f / n.z, height = theirs.z - 0.5f * bent * over_z;
            const Vector turned = {turn[0] * before.x + turn[1] * before.y + turn[2] * before.z,
                                   turn[3] * before.x + turn[4] * before.y + turn[5] * before.z,
                                   turn[6] * before.x + turn[7] * before.y + turn[8] * before.z};
            const Symmetric shape_here = variances(before, turn, turned.x, turned.y, mine.square, flat_limit);
            const Symmetric other = same_variances(n, theirs.square, other_flat_limit);
            const F xx = shape_here.xx + other.xx, xy = shape_here.xy + other.xy, yy = shape_here.yy + other.yy;
            const F area = xx * yy - xy * xy;
            const I is_clear = defined & (xx + yy < VAGUE);
            const F low = inverse_roots(xx), long_side = inverse_roots(area) * xx * low;
            const F lift = (turn[2] * n.x + turn[5] * n.y + turn[8] * n.z) * over_z, own_height = lift * lift * mine.variance;
            const I compared = defined & (mine.variance < NEAR) & (theirs.variance < NEAR);
            const F d0 = (turned.x - n.x) * low, d1 = (turned.y - n.y - xy * low * d0) * long_side;
            const F firm = compared ? inverse_roots(own_height + theirs.variance) : (F)0.0f, d2 = firm * (place.z - height);
            const I kept = (is_clear ? d0 * d0 + d1 * d1 : (F)0.0f) + d2 * d2 <= limit;
            const I with_normal = kept & is_clear, with_height = kept & compared;
            const F one = with_normal ? (F)1.0f : (F)0.0f, height_weight = with_height ? firm : (F)0.0f;
            const Vector lower = {one * low, xy * low, one * long_side};
            const F r0 = with_normal ? d0 : (F)0.0f, r1 = with_normal ? d1 : (F)0.0f, r2 = with_height ? d2 : (F)0.0f;
            const F traced = (yy * other.xx - 2.0f * xy * other.xy + xx * other.yy) / area;
            Jacobian j;
            jacobian(n, (Symmetric){theirs.xx, theirs.xy, theirs.yy}, over_z, arm, lower, height_weight, &j);
            UNROLL for (int i = 0; i < 6; ++i) {
                UNROLL for (int k = 0; k < 6; ++k)
                    if (k >= i) total[UPPER(i, k)] += PRODUCT(j, i, j, k);
                total[21 + i] += (i < 5 ? j.x[i] * r0 + j.y[i] * r1 : 0.0f) + j.z[i] * r2;
            }
            total[27] += r0 * r0 + r1 * r1 + r2 * r2;
            total[28] += one * (2.0f - (1.0f - fraction) * traced)
                + height_weight * height_weight * (own_height + fraction * theirs.variance);
            total[29] += with_height ? (F)1.0f : (F)0.0f;
            total[30] += one;
#if BESIDE
            const F over_turned = 1.0f / turned.z;
            const Symmetric curved = turn_curvature(before.z, (Symmetric){mine.xx, mine.xy, mine.yy}, over_turned, turn, turned);
            Jacobian other_jacobian;
            jacobian(turned, curved, over_turned, arm, lower, height_weight, &other_jacobian);
            UNROLL for (int i = 0; i < 6; ++i)
                UNROLL for (int k = 0; k < 6; ++k) total[31 + 6 * i + k] += PRODUCT(j, i, other_jacobian, k);
#endif
        }
    OUT out = sums + item * SUMS;
    UNROLL for (int i = 0; i < SUMS; ++i) out[i] = sum_over_lanes(total[i]);
}
