// Normal equations of a rigid motion between two maps. Specification: pose.py.
//
// TILE     pixels of one work-item of pose_gradient
// BESIDE   1 where the Jacobian by the first map's own curvature is wanted too

#include "common.clh"

#define AROUND 2
#define LEAST 7
#define FLAT 1e-3f
#define BLOCK 8
#define SUMS 67
#define POSE 25
#define NEAR 1e20f
#define VAGUE 100.0f

__kernel void pose_gradient(
    const int rows, const int columns, const float step_x, const float step_y, MAP values, OUT gradient)
{
    const int first = (int)get_global_id(0) * TILE;
    for (int p = first; p < LESSER(first + TILE, rows * columns); ++p) {
        const int row = p / columns, column = p % columns;
        const int left = LESSER(AROUND, column), right = LESSER(AROUND, columns - 1 - column);
        const float here = values[p];
        float count = 0, x = 0, y = 0, xx = 0, xy = 0, yy = 0, z = 0, xz = 0, yz = 0;
        for (int below = -LESSER(AROUND, row); below <= LESSER(AROUND, rows - 1 - row); ++below)
            for (int beside = -left; beside <= right; ++beside) {
                const float value = values[p + below * columns + beside] - here;
                const int known = value == value;
                const float one = known ? 1.0f : 0.0f, rise = known ? value : 0.0f, i = beside * one, j = below * one;
                count += one;
                x += i;
                y += j;
                xx += i * beside;
                xy += i * below;
                yy += j * below;
                z += rise;
                xz += rise * beside;
                yz += rise * below;
            }
        const float mean_x = x / count, mean_y = y / count;
        xx -= x * mean_x;
        xy -= x * mean_y;
        yy -= y * mean_y;
        xz -= z * mean_x;
        yz -= z * mean_y;
        const float area = xx * yy - xy * xy;
        const int good = count >= LEAST && area > FLAT * count * count;
        gradient[2 * p] = good ? (yy * xz - xy * yz) / area / step_x : NAN;
        gradient[2 * p + 1] = good ? -(xx * yz - xy * xz) / area / step_y : NAN;
    }
}

float upright(const float x, const float y) { return root(GREATER(1.0f - x * x - y * y, 1e-6f)); }

// Covariance xx, xy, yy of a normal's x and y after a rotation.
float3 variances(const float x, const float y, const float *turn, const float square, const float least)
{
    const float flat = x * x + y * y, outside = GREATER(flat, least), z = upright(x, y);
    const float share = 0.5f * least / outside, across = (1.0f - share) * square;
    const float more = (2.0f * share - 1.0f) * square / outside;
    const float u = turn[0] * x + turn[1] * y + turn[2] * z, v = turn[3] * x + turn[4] * y + turn[5] * z;
    const float a = z * (turn[0] * x + turn[1] * y) - turn[2] * flat, b = z * (turn[3] * x + turn[4] * y) - turn[5] * flat;
    return (float3)(across * (1.0f - u * u) + more * a * a, more * a * b - across * u * v,
                    across * (1.0f - v * v) + more * b * b);
}

float3 same_variances(const float x, const float y, const float z, const float square, const float least)
{
    const float flat = x * x + y * y, outside = GREATER(flat, least);
    const float share = 0.5f * least / outside, across = (1.0f - share) * square;
    const float more = (2.0f * share - 1.0f) * square / outside * z * z - across;
    return (float3)(across + more * x * x, more * x * y, across + more * y * y);
}

// A second derivative of F = z - h(x, y) after a rotation.
#define SECOND(i, j)                                                                                              \
    -(h.x * turn[3 * i] * turn[3 * j] + h.y * (turn[3 * i] * turn[3 * j + 1] + turn[3 * i + 1] * turn[3 * j])       \
      + h.z * turn[3 * i + 1] * turn[3 * j + 1])

float3 turn_curvature(const float z_before, const float3 h, const float *turn, const float3 n)
{
    const float p = -n.x / n.z, q = -n.y / n.z, scale = z_before / n.z;
    const float xx = SECOND(0, 0), xy = SECOND(0, 1), yy = SECOND(1, 1), xz = SECOND(0, 2), yz = SECOND(1, 2), zz = SECOND(2, 2);
    return -scale * (float3)(xx + 2.0f * xz * p + zz * p * p, xy + xz * q + yz * p + zz * p * q, yy + 2.0f * yz * q + zz * q * q);
}

// Three rows of the Jacobian, six numbers each in a vector of eight; the first two are whitened.
void jacobian(const float3 n, const float3 h, const float3 arm, const float3 lower, const float sure, float8 *rows)
{
    const float8 move_x = (float8)(0, arm.z, -arm.y, 1, 0, 0, 0, 0), move_y = (float8)(-arm.z, 0, arm.x, 0, 1, 0, 0, 0);
    const float8 move_z = (float8)(arm.y, -arm.x, 0, 0, 0, 1, 0, 0);
    const float8 turn_x = (float8)(0, n.z, -n.y, 0, 0, 0, 0, 0), turn_y = (float8)(-n.z, 0, n.x, 0, 0, 0, 0, 0);
    const float8 change_x = h.x * move_x + h.y * move_y, change_y = h.y * move_x + h.z * move_y;
    const float8 along = n.x * change_x + n.y * change_y;
    const float8 x = turn_x + n.z * (change_x - n.x * along), y = turn_y + n.z * (change_y - n.y * along);
    rows[0] = x * lower.x;
    rows[1] = (y - lower.y * rows[0]) * lower.z;
    const float by = sure / n.z;
    rows[2] = sure * move_z + by * n.x * move_x + by * n.y * move_y;
}

// Of pose after pose, and block after block of the first map's pixels: the sums that pose.py names, SUMS numbers each.
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
    for (int i = 0; i < 9; ++i) turn[i] = pose[i];
    const float3 shift = vload3(3, pose), centre = vload3(4, pose);
    const float x0 = pose[15], y0 = pose[16], step_x = pose[17], step_y = pose[18], least = pose[23];
    const float other_x = pose[19], other_y = pose[20], wide = pose[21], high = pose[22], other_least = pose[24];
    const float east_x = 1.0f / wide, south_y = 1.0f / high;
    float8 upper[6], whole[6], right = 0.0f;
    float chi = 0, expected = 0, heights = 0, normals = 0;
    for (int i = 0; i < 6; ++i) upper[i] = whole[i] = 0.0f;
    for (int row = top; row < LESSER(top + side, rows); row += step)
        for (int column = begin; column < LESSER(begin + side, columns); column += step) {
            const float8 mine = vload8(row * columns + column, first);
            if (mine.s0 != mine.s0) continue;
            const float x = x0 + column * step_x, y = y0 - row * step_y, z = mine.s3;
            const float3 place = (float3)(turn[0] * x + turn[1] * y + turn[2] * z + shift.x,
                                          turn[3] * x + turn[4] * y + turn[5] * z + shift.y,
                                          turn[6] * x + turn[7] * y + turn[8] * z + shift.z);
            const float to_right = (place.x - other_x) * east_x, to_below = (other_y - place.y) * south_y;
            if (!(to_right >= 0.0f && to_right < other_columns - 1 && to_below >= 0.0f && to_below < other_rows - 1))
                continue;
            const int west = to_right, north = to_below, at = north * other_columns + west;
            const float u = to_right - west, v = to_below - north;
            const float left = 1.0f - u, above = 1.0f - v;
            const float nw = left * above, ne = u * above, sw = left * v, se = u * v;
            const float8 a_nw = vload8(at, second), a_ne = vload8(at + 1, second);
            const float8 a_sw = vload8(at + other_columns, second), a_se = vload8(at + other_columns + 1, second);
            const float8 found = nw * a_nw + ne * a_ne + sw * a_sw + se * a_se;
            if (found.s0 != found.s0) continue;
            const float share = (u * u + (1.0f - u) * (1.0f - u)) * (v * v + (1.0f - v) * (1.0f - v));
            const float3 n = (float3)(found.s0, found.s1, upright(found.s0, found.s1)), arm = place - centre;
            const float bent_x = u * left * (above * (a_nw.s0 - a_ne.s0) + v * (a_sw.s0 - a_se.s0)) * wide;
            const float bent_y = v * above * (left * (a_nw.s1 - a_sw.s1) + u * (a_ne.s1 - a_se.s1)) * high;
            const float height = found.s3 - 0.5f * (bent_x - bent_y) / n.z;
            const float z_before = upright(mine.s0, mine.s1);
            const float3 turned = (float3)(turn[0] * mine.s0 + turn[1] * mine.s1 + turn[2] * z_before,
                                           turn[3] * mine.s0 + turn[4] * mine.s1 + turn[5] * z_before,
                                           turn[6] * mine.s0 + turn[7] * mine.s1 + turn[8] * z_before);
            const float3 other = same_variances(n.x, n.y, n.z, found.s2, other_least);
            const float3 both = variances(mine.s0, mine.s1, turn, mine.s2, least) + other;
            const float area = both.x * both.z - both.y * both.y;
            const float low = inverse_root(both.x), told = both.x + both.z < VAGUE ? 1.0f : 0.0f;
            const float3 lower = (float3)(told * low, both.y * low, told * inverse_root(area) / low);
            const float lift = (turn[2] * n.x + turn[5] * n.y + turn[8] * n.z) / n.z, own = lift * lift * mine.s4;
            const int compared = mine.s4 < NEAR && found.s4 < NEAR;
            const float sure = compared ? inverse_root(own + found.s4) : 0.0f;
            float8 mine_rows[3];
            jacobian(n, (float3)(found.s5, found.s6, found.s7), arm, lower, sure, mine_rows);
            const float r0 = (turned.x - n.x) * lower.x, r1 = (turned.y - n.y - lower.y * r0) * lower.z;
            const float r2 = sure * (place.z - height);
            const float8 a = mine_rows[0], b = mine_rows[1], c = mine_rows[2];
            right += a * r0 + b * r1 + c * r2;
            chi += r0 * r0 + r1 * r1 + r2 * r2;
            const float traced = (both.z * other.x - 2.0f * both.y * other.y + both.x * other.z) / area;
            expected += told * (2.0f - (1.0f - share) * traced) + sure * sure * (own + share * found.s4);
            heights += compared ? 1.0f : 0.0f;
            normals += told;
            upper[0] += a.s0 * a + b.s0 * b + c.s0 * c;
            upper[1] += a.s1 * a + b.s1 * b + c.s1 * c;
            upper[2] += a.s2 * a + b.s2 * b + c.s2 * c;
            upper[3] += a.s3 * a + b.s3 * b + c.s3 * c;
            upper[4] += a.s4 * a + b.s4 * b + c.s4 * c;
            upper[5] += a.s5 * a + b.s5 * b + c.s5 * c;
#if BESIDE
            const float3 curved = turn_curvature(z_before, (float3)(mine.s5, mine.s6, mine.s7), turn, turned);
            float8 own_rows[3];
            jacobian(turned, curved, arm, lower, sure, own_rows);
            const float8 d = own_rows[0], e = own_rows[1], f = own_rows[2];
            whole[0] += a.s0 * d + b.s0 * e + c.s0 * f;
            whole[1] += a.s1 * d + b.s1 * e + c.s1 * f;
            whole[2] += a.s2 * d + b.s2 * e + c.s2 * f;
            whole[3] += a.s3 * d + b.s3 * e + c.s3 * f;
            whole[4] += a.s4 * d + b.s4 * e + c.s4 * f;
            whole[5] += a.s5 * d + b.s5 * e + c.s5 * f;
#endif
        }
    OUT out = sums + item * SUMS;
    int k = 0;
    for (int i = 0; i < 6; ++i) {
        float line[8];
        vstore8(upper[i], 0, line);
        for (int j = i; j < 6; ++j) out[k++] = line[j];
    }
    float line[8];
    vstore8(right, 0, line);
    for (int j = 0; j < 6; ++j) out[k++] = line[j];
    out[k++] = chi;
    out[k++] = expected;
    out[k++] = heights;
    out[k++] = normals;
    for (int i = 0; i < 6; ++i) {
        vstore8(whole[i], 0, line);
        for (int j = 0; j < 6; ++j) out[k++] = line[j];
    }
}
