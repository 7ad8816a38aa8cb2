// Normal equations of a rigid motion between two maps. Specification: pose.py.
//
// TILE     1 on a GPU; otherwise an item processes a row of LANES pixels at once
// BESIDE   1 if the Jacobian by the first map's own curvature is also computed
// GROUP    items of the work-group of pose_follow

#include "common.clh"

#include "pose.clh"

#define INLINE static inline __attribute__((always_inline))

#define SUMS (BESIDE ? 67 : 31)
#define NEAR 1e20f

#define LOAD(map, p) (*(__global const Loose *)((map) + 8 * (p)))
#define KEEP(values, memory) (*(Lanes *)(memory) = (values))
typedef float8 __attribute__((aligned(4))) Loose;  // unaligned

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
#else
Record transposed(const float8 *r)
{
    return (Record){r->s0, r->s1, r->s2, r->s3, r->s4, r->s5, r->s6, r->s7};
}
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

// A motion, its two maps' positions and limits, as described in pose.py.
typedef struct {
    float turn[9], shift[3], centre[3], grid[4], other_grid[4], flat_limit, other_flat_limit, limit;
} Pose;

#define BLOCKS_ACROSS(columns, step) (((columns) + BLOCK * (step) - 1) / (BLOCK * (step)))
#define BLOCKS(rows, columns, step) (BLOCKS_ACROSS(rows, step) * BLOCKS_ACROSS(columns, step))

// Writes the SUMS sums described in pose.py over a block of the first map's pixels.
INLINE void add_block(
    const int block, const int rows, const int columns, const int other_rows, const int other_columns, const int step,
    MAP first, MAP second, const Pose *pose, OUT sums)
{
    const int side = BLOCK * step, across = BLOCKS_ACROSS(columns, step);
    const int top = block / across * side, begin = block % across * side;
    const float *turn = pose->turn;
    const float3 shift = vload3(0, pose->shift), centre = vload3(0, pose->centre);
    const float x0 = pose->grid[0], y0 = pose->grid[1], step_x = pose->grid[2], step_y = pose->grid[3];
    const float other_x = pose->other_grid[0], other_y = pose->other_grid[1];
    const float wide = pose->other_grid[2], high = pose->other_grid[3];
    const float flat_limit = pose->flat_limit, other_flat_limit = pose->other_flat_limit, limit = pose->limit;
    const float east_x = 1.0f / wide, south_y = 1.0f / high;
    F total[SUMS];
    UNROLL for (int i = 0; i < SUMS; ++i) total[i] = 0.0f;
    for (int row = top; row < LESSER(top + side, rows); row += step)
        for (int column = begin; column < LESSER(begin + side, columns); column += LANES * step) {
            float8 records[LANES];
            UNROLL for (int i = 0; i < LANES; ++i)
                records[i] = LOAD(first, row * columns + LESSER(column + i * step, columns - 1));
            Record mine = transposed(records);
            const I number = column + step * ORDER;
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
    UNROLL for (int i = 0; i < SUMS; ++i) sums[i] = sum_over_lanes(total[i]);
}

// For each pose and each block of the first map's pixels: the SUMS sums.
__kernel void pose_equations(
    const int count, const int rows, const int columns, const int other_rows, const int other_columns, MAP first,
    MAP second, __global const Pose *restrict poses, OUT sums)
{
    const int item = get_global_id(0), blocks = BLOCKS(rows, columns, 1);
    if (item / blocks >= count) return;
    const Pose pose = poses[item / blocks];
    add_block(item % blocks, rows, columns, other_rows, other_columns, 1, first, second, &pose, sums + item * SUMS);
}

#define STRIDE 4
#define MAX_COARSE 8
#define MAX_FINE 4
#define CLOSE 3.0f
#define EXACT 0.1f
#define CLEAR 3.0f
#define FEWEST 20.0f
#define MIN_KEPT 0.5f
#define LOST 3.0f
#define OUTLIER 30.0f
#define NO_LIMIT 1e30f
#define LEAST 1e-6f
#define MAX_STEP 0.35f
#define INDEPENDENT 100.0f

#define SCALE(i) ((i) < 3 ? per_size : 1.0f)
#define AT(i, k) UPPER(LESSER(i, k), GREATER(i, k))
#define CHI_SQUARE (total[27] / GREATER(total[28], 1e-9f))

// What stays the same while maps are compared with one map.
typedef struct {
    float centre[3], grid[4], other_grid[4], flat_limit, other_flat_limit, size, typical, projection[36];
} Key;

// Solves an equation with a positive definite matrix by Cholesky's method; the matrix is overwritten.
INLINE void solve(float matrix[6][6], float *right)
{
    UNROLL for (int i = 0; i < 6; ++i) {
        UNROLL for (int k = 0; k <= i; ++k) {
            float rest = matrix[i][k];
            UNROLL for (int j = 0; j < k; ++j) rest -= matrix[i][j] * matrix[k][j];
            matrix[i][k] = k < i ? rest * matrix[k][k] : inverse_root(GREATER(rest, 1e-30f));  // 1 / the diagonal
        }
        UNROLL for (int k = 0; k < i; ++k) right[i] -= matrix[i][k] * right[k];
        right[i] *= matrix[i][i];
    }
    UNROLL for (int i = 5; i >= 0; --i) {
        UNROLL for (int k = i + 1; k < 6; ++k) right[i] -= matrix[k][i] * right[k];
        right[i] *= matrix[i][i];
    }
}

// The inverse of a matrix in the directions of a projection. In the others it gets a diagonal for the inversion.
INLINE void invert(const float full[6][6], const float *projection, float inverse[6][6])
{
    float part[6][6], trace = 0;
    for (int i = 0; i < 6; ++i) trace += full[i][i];
    for (int i = 0; i < 6; ++i)
        for (int k = 0; k < 6; ++k) {
            part[i][k] = 0;
            for (int j = 0; j < 6; ++j) part[i][k] += projection[6 * i + j] * full[j][k];
        }
    for (int row = 0; row < 6; ++row) {
        float matrix[6][6], right[6];
        for (int i = 0; i < 6; ++i) {
            right[i] = projection[6 * i + row];
            for (int k = 0; k < 6; ++k) {
                matrix[i][k] = trace / 6 * ((i == k) - projection[6 * i + k]);
                for (int j = 0; j < 6; ++j) matrix[i][k] += part[i][j] * projection[6 * j + k];
            }
        }
        solve(matrix, right);
        for (int i = 0; i < 6; ++i) inverse[row][i] = right[i];
    }
}

// A Gauss-Newton step in the directions of a projection; also returns the step in standard deviations.
INLINE float find_step(const float *total, const float *projection, const float per_size, float *step)
{
    float full[6][6], part[6][6], matrix[6][6], right[6], trace = 0, kept = 0;
    for (int i = 0; i < 6; ++i) {
        right[i] = 0;
        for (int k = 0; k < 6; ++k) {
            full[i][k] = total[AT(i, k)] * SCALE(i) * SCALE(k);
            right[i] -= projection[6 * i + k] * total[21 + k] * SCALE(k);
        }
        trace += full[i][i];
        kept += projection[7 * i];
    }
    for (int i = 0; i < 6; ++i)
        for (int k = 0; k < 6; ++k) {
            part[i][k] = 0;
            for (int j = 0; j < 6; ++j) part[i][k] += projection[6 * i + j] * full[j][k];
        }
    float projected = 0;
    for (int i = 0; i < 6; ++i)
        for (int k = 0; k < 6; ++k) {
            matrix[i][k] = 0;
            for (int j = 0; j < 6; ++j) matrix[i][k] += part[i][j] * projection[6 * j + k];
            if (i == k) projected += matrix[i][k];
        }
    // The other directions get a diagonal of their own, so that the step along them is 0.
    for (int i = 0; i < 6; ++i)
        for (int k = 0; k < 6; ++k) {
            const float own = projection[6 * i + k];
            matrix[i][k] += LEAST * projected / kept * own + trace / 6 * ((i == k) - own);
        }
    solve(matrix, right);
    float square = 0, gain = 0;
    for (int i = 0; i < 6; ++i) square += right[i] * right[i];
    const float shorter = 1.0f / GREATER(root(square) * per_size / MAX_STEP, 1.0f);
    for (int i = 0; i < 6; ++i) step[i] = shorter * right[i];
    for (int i = 0; i < 6; ++i)
        for (int k = 0; k < 6; ++k) gain += step[i] * full[i][k] * step[k];
    for (int i = 0; i < 6; ++i) step[i] *= SCALE(i);
    return root(GREATER(gain, 1e-30f) / GREATER(CHI_SQUARE, 1.0f));
}

// Adds a small rotation about the centre, by Cayley's formula, and a translation.
INLINE void move(Pose *pose, const float *step)
{
    const float x = step[0], y = step[1], z = step[2], scale = 1 / (1 + 0.25f * (x * x + y * y + z * z));
    const float low = 0.5f * scale;
    const float small[9] = {
        1 - low * (y * y + z * z), low * x * y - scale * z, low * x * z + scale * y,
        low * x * y + scale * z, 1 - low * (x * x + z * z), low * y * z - scale * x,
        low * x * z - scale * y, low * y * z + scale * x, 1 - low * (x * x + y * y)};
    float turn[9], arm[3];
    for (int i = 0; i < 3; ++i) arm[i] = pose->shift[i] - pose->centre[i];
    for (int i = 0; i < 3; ++i) {
        for (int k = 0; k < 3; ++k)
            turn[3 * i + k] = small[3 * i] * pose->turn[k] + small[3 * i + 1] * pose->turn[3 + k] + small[3 * i + 2] * pose->turn[6 + k];
        pose->shift[i] = pose->centre[i] + step[3 + i] + small[3 * i] * arm[0] + small[3 * i + 1] * arm[1] + small[3 * i + 2] * arm[2];
    }
    for (int i = 0; i < 9; ++i) pose->turn[i] = turn[i];
}

// The motion from one map to another near an expected one, by one work-group.
__kernel GROUP_SIZE void pose_follow(
    const int rows, const int columns, const int other_rows, const int other_columns, const float4 expected_x,
    const float4 expected_y, const float4 expected_z, const float expected_bend, __global const Key *restrict key,
    MAP first, MAP second, OUT sums, OUT found)
{
    const int item = get_local_id(0);
    const Key fixed = *key;
    const float per_size = 1.0f / fixed.size;
    Pose pose, rough;
    float total[SUMS], step[6];
    const float4 expected[3] = {expected_x, expected_y, expected_z};
    for (int i = 0; i < 3; ++i) {
        pose.turn[3 * i] = expected[i].x;
        pose.turn[3 * i + 1] = expected[i].y;
        pose.turn[3 * i + 2] = expected[i].z;
        pose.shift[i] = expected[i].w;
        pose.centre[i] = fixed.centre[i];
    }
    for (int i = 0; i < 4; ++i) {
        pose.grid[i] = fixed.grid[i];
        pose.other_grid[i] = fixed.other_grid[i];
    }
    pose.flat_limit = fixed.flat_limit;
    pose.other_flat_limit = fixed.other_flat_limit;
    float bend = expected_bend, last = 0, shared = 0;
    int coarse = 0, fine = -1, blocks = 0;  // fine: number of steps with all pixels, -1 during coarse ones
    while (coarse < MAX_COARSE || fine >= 0) {
        const int stride = fine < 0 ? STRIDE : 1;
        pose.limit = fine < 0 ? NO_LIMIT : OUTLIER * fixed.typical;
        blocks = BLOCKS(rows, columns, stride);
        for (int block = item; block < blocks; block += ITEMS)
            add_block(
                block, rows, columns, other_rows, other_columns, stride, first, second, &pose, sums + block * SUMS);
        BARRIER;
        for (int i = 0; i < SUMS; ++i) total[i] = 0;
        for (int block = 0; block < blocks; ++block)
            for (int i = 0; i < SUMS; ++i) total[i] += sums[block * SUMS + i];
        BARRIER;
        const float pixels = GREATER(total[29], total[30]);
        if (fine < 0 && pixels < FEWEST) break;
        if (fine >= 0 && (pixels < GREATER(MIN_KEPT * shared, FEWEST) || CHI_SQUARE > LOST * fixed.typical)) {
            fine = -1;
            pose = rough;
            continue;
        }
        const float moved = find_step(total, fixed.projection, per_size, step);
        move(&pose, step);
        if (fine >= 0) {
            ++fine;
            if (LESSER(moved, bend / STRIDE * moved * moved) < EXACT || fine == MAX_FINE) break;
            continue;
        }
        if (last > CLEAR) bend = moved / (last * last);
        last = moved;
        ++coarse;
        if (LESSER(moved, bend * moved * moved) < CLOSE) {
            fine = 0;
            shared = pixels * STRIDE * STRIDE;
            rough = pose;
        }
    }
    if (fine < 0) {
        if (item == 0) found[0] = 0;
        return;
    }
    // The sums after the last step, for residuals that are linear in it.
    for (int block = item; block < blocks; block += ITEMS) {
        OUT own = sums + block * SUMS;
        for (int i = 0; i < 6; ++i)
            for (int k = 0; k < 6; ++k) own[21 + i] += own[AT(i, k)] * step[k];
    }
    BARRIER;
    for (int i = 0; i < 6; ++i)
        for (int k = i; k < 6; ++k) {
            if (UPPER(i, k) % ITEMS != item) continue;
            float scatter = 0;
            for (int block = 0; block < blocks; ++block) scatter += sums[block * SUMS + 21 + i] * sums[block * SUMS + 21 + k];
            found[16 + UPPER(i, k)] = scatter;
        }
    BARRIER;
    if (item > 0) return;
    for (int i = 0; i < 6; ++i) {
        float added = 0;
        for (int k = 0; k < 6; ++k) added += total[AT(i, k)] * step[k];
        total[27] += (2 * total[21 + i] + added) * step[i];
    }
    int used = 0;
    for (int block = 0; block < blocks; ++block) used += sums[block * SUMS + 29] + sums[block * SUMS + 30] > 0;
    float full[6][6], inverse[6][6], scatter[6][6], part[6][6], size = 0, rank = 0;
    for (int i = 0; i < 6; ++i) {
        rank += fixed.projection[7 * i];
        for (int k = 0; k < 6; ++k) {
            const float scale = SCALE(i) * SCALE(k);
            full[i][k] = total[AT(i, k)] * scale;
            scatter[i][k] = found[16 + AT(i, k)] * scale * used / GREATER(used - 6.0f, 1.0f);
        }
    }
    invert(full, fixed.projection, inverse);
    for (int i = 0; i < 6; ++i)
        for (int k = 0; k < 6; ++k) {
            part[i][k] = 0;
            for (int j = 0; j < 6; ++j) part[i][k] += inverse[i][j] * scatter[j][k];
            if (i == k) size += part[i][i] / rank;
        }
    const float share = used / (used + INDEPENDENT);
    for (int i = 0; i < 6; ++i)
        for (int k = i; k < 6; ++k) {
            float covariance = 0;
            for (int j = 0; j < 6; ++j) covariance += part[i][j] * inverse[j][k];
            found[16 + UPPER(i, k)] = share * covariance + (1 - share) * size * inverse[i][k];
        }
    found[0] = used;
    found[1] = bend;
    for (int i = 0; i < 9; ++i) found[2 + i] = pose.turn[i];
    for (int i = 0; i < 3; ++i) found[11 + i] = pose.shift[i];
    found[14] = GREATER(total[29], total[30]);
    found[15] = CHI_SQUARE;
}
