// Surface normals with a cylindrical wall: samples are lights, not zeniths. Specification: normals_wall.py, response.py;
// macros and arguments: normals.clh.

#include "normals.clh"

#define STEPS 3  // Gauss-Newton steps of all pixels

// The wall's parameters, before those of its inverse and its curve.
enum {
    RADIUS,
    RIM,
    SCATTER,  // squared sine of its half-angle
    BEND,
    BEND_SQUARE,
    LAMP_X,  // relative to the radius, like LAMP_Y
    LAMP_Y,
    NEAREST,  // range of q in which the curve is valid
    FURTHEST,
    DARKEST,  // corresponding lights
    LIGHTEST,
    SENSE,  // 1 if steeper is brighter, -1 if it is darker
    PIVOT_X,
    PIVOT_Y,
    PIVOT_Z,
    MIDDLE,  // origin and scale of q in the curve
    PER_Q,
    INVERSE
};

typedef struct {
    MAP is;
    int inverse_length, curve_length;
    int follows;  // whether a pixel follows one point of the object
    float cos_tilt, sin_tilt;
} Wall;

// The point that a pixel sees in the mean pose, the shift of its line of sight per mm of z, and that per mm
// from the axis.
typedef struct { F x, y, z, slope_x, slope_y, bend; } Place;

// The expected light of a sample; its derivatives along the meridian, across it and with respect to the tilt,
// weighted; and whether all its rays meet the wall.
typedef struct { F light, u1, u2, u3; I inside; } Expected;

Place place_of(const Wall wall, const F x, const F y, const F z)
{
    const F bend = wall.is[BEND] + wall.is[BEND_SQUARE] * (x * x + y * y);
    const Place place = {x * (1.0f - z * bend), y * (1.0f - z * bend), z, -bend * x, -bend * y, bend};
    return place;
}

// Normal and point are first rotated with the body: only along the phase's direction and up. The line of
// sight need not be a unit vector.
Expected expect(const Direction at, const Place place, const Wall wall, const Samples of, const int k)
{
    const float c = entry(of, COSINE, k), s = entry(of, SINE, k), root = entry(of, ROOT_WEIGHT, k);
    const float cos_tilt = wall.cos_tilt, sin_tilt = wall.sin_tilt, radius = wall.is[RADIUS];
    const F nx = at.st * at.cp, ny = at.st * at.sp, nz = at.ct;
    const F flat_n = nx * c + ny * s, out_n = flat_n * cos_tilt + nz * sin_tilt;
    const F bz = nz * cos_tilt - flat_n * sin_tilt, bx = nx + c * (out_n - flat_n), by = ny + s * (out_n - flat_n);
    const F out_p = (place.x - wall.is[PIVOT_X]) * c + (place.y - wall.is[PIVOT_Y]) * s;
    const F up_p = place.z - wall.is[PIVOT_Z], pz = wall.is[PIVOT_Z] + up_p * cos_tilt - out_p * sin_tilt;
    F sx = place.slope_x, sy = place.slope_y, px, py;
    if (wall.follows) {
        const F shift = out_p * (cos_tilt - 1.0f) + up_p * sin_tilt;
        px = place.x + c * shift;
        py = place.y + s * shift;
        sx -= place.bend * c * shift;
        sy -= place.bend * s * shift;
    } else {
        px = place.x + (pz - place.z) * sx;
        py = place.y + (pz - place.z) * sy;
    }

    // The intersection of the reflected ray with the wall, and the light there.
    const F facing = sx * bx + sy * by + bz, twice = facing + facing;
    const F rx = twice * bx - sx, ry = twice * by - sy, rz = twice * bz - 1.0f, flat = rx * rx + ry * ry;
    const F power = radius * radius - px * px - py * py, along = px * rx + py * ry;
    const F square = along * along + flat * power, per_leave = inverse_roots(square);
    const F distance = power / (along + square * per_leave);
    const F mx = px + distance * rx, my = py + distance * ry, h = pz + distance * rz;
    const F far = h * h + radius * radius, per_far = inverse_roots(far), per_both = 1.0f / (far * per_far + radius);
    const F q = h * per_both, above_nearest = GREATER(q, (F)wall.is[NEAREST]), held = LESSER(above_nearest, (F)wall.is[FURTHEST]);
    const F place_q = (held - wall.is[MIDDLE]) * wall.is[PER_Q];
    MAP curve = wall.is + INVERSE + wall.inverse_length;
    F level = curve[wall.curve_length - 1], steep = 0.0f;
    for (int i = wall.curve_length - 2; i >= 0; --i) {
        steep = steep * place_q + level;
        level = level * place_q + curve[i];
    }
    steep *= wall.is[PER_Q];
    level += steep * (q - held);

    // Its derivatives with respect to the normal in the body's frame, and in the mean pose.
    const float lamp_x = wall.is[LAMP_X], lamp_y = wall.is[LAMP_Y];
    const F lamp = 1.0f + lamp_x * mx + lamp_y * my, by_height = lamp * steep * (radius * per_far * per_both);
    const F further = (level * (lamp_x * rx + lamp_y * ry) + by_height * rz) * per_leave;
    const F gx = distance * (level * lamp_x - further * mx), gy = distance * (level * lamp_y - further * my);
    const F gz = distance * by_height;
    const F pull_n = gx * bx + gy * by + gz * bz;
    const F vx = 2.0f * (facing * gx + pull_n * sx), vy = 2.0f * (facing * gy + pull_n * sy);
    const F vz = 2.0f * (facing * gz + pull_n), flat_v = vx * c + vy * s;
    const F back = flat_v * cos_tilt - vz * sin_tilt - flat_v;
    const F wx = vx + c * back, wy = vy + s * back, wz = flat_v * sin_tilt + vz * cos_tilt;
    Expected expected;
    expected.light = lamp * level;
    expected.u1 = root * (at.ct * (at.cp * wx + at.sp * wy) - at.st * wz);
    expected.u2 = root * (at.cp * wy - at.sp * wx);
    expected.u3 = root * (flat_v * bz - vz * out_n);

    // Whether the rays deflected up and down by the scatter also meet the wall: by the sines of the angles to
    // its edges.
    const F below = wall.is[RIM] - h, over = wall.is[RIM] - pz, apart = distance * distance * flat;
    const F turned = wall.is[SCATTER] * (sx * sx + sy * sy + 1.0f);
    expected.inside = (q == held) & (below >= 0.0f) & (h >= 0.0f)
        & (flat * below * below >= turned * (apart + over * over)) & (flat * h * h >= turned * (apart + pz * pz));
    return expected;
}

// The mean light corresponds to a height on the wall; the wave gives the azimuth, and thus the distance to
// the wall. A missing sample is replaced by the mean of the others.
Direction begin_at(const Samples of, const F mean, const Place place, const Wall wall)
{
    const float radius = wall.is[RADIUS], nearest = wall.is[NEAREST], furthest = wall.is[FURTHEST];
    MAP inverse = wall.is + INVERSE;
    F x = 0.0f, y = 0.0f, q = inverse[wall.inverse_length - 1];
    for (int k = 0; k < of.count; ++k) {
        const F light = zenith_of(of, raw_of(of, k)), deviation = light == light ? light - mean : (F)0.0f;
        x += entry(of, IN_COSINE, k) * deviation;
        y += entry(of, IN_SINE, k) * deviation;
    }
    const F limited = LESSER(mean, (F)wall.is[LIGHTEST]), light = GREATER(limited, (F)wall.is[DARKEST]);
    for (int i = wall.inverse_length - 2; i >= 0; --i) q = q * light + inverse[i];
    q = q < nearest ? (F)nearest : q;
    q = q > furthest ? (F)furthest : q;
    const F square = x * x + y * y;
    const I modulated = square > 0.0f;
    const F per_amplitude = wall.is[SENSE] * inverse_roots(modulated ? square : (F)1.0f);
    x = modulated ? x * per_amplitude : (F)1.0f;
    y = modulated ? y * per_amplitude : (F)0.0f;
    const F along = place.x * x + place.y * y;
    const F out = roots(along * along + radius * radius - place.x * place.x - place.y * place.y) - along;
    const F rise = 2.0f * radius * q / (1.0f - q * q) - place.z, per_ray = inverse_roots(out * out + rise * rise);
    const F per_sight = inverse_roots(place.slope_x * place.slope_x + place.slope_y * place.slope_y + 1.0f);
    return direction_of(out * x * per_ray + place.slope_x * per_sight, out * y * per_ray + place.slope_y * per_sight,
                        rise * per_ray + per_sight);
}

// The normal equations at a direction for samples that are all valid and in range.
Sums look(const Direction at, const Samples of, const Place place, const Wall wall, const Wave wave)
{
    Sums sums = {0};
    for (int k = 0; k < of.count; ++k) {
        const F light = zenith_of(of, raw_of(of, k)), off = off_wave(of, k, light, wave);
        const Expected expected = expect(at, place, wall, of, k);
        const F error = entry(of, ROOT_WEIGHT, k) * (light - expected.light);
        add(&sums, expected.u1, expected.u2, expected.u3, 1.0f, error, error * error);
        sums.waves += off * off;
        sums.within += expected.inside & 1;
    }
    return sums;
}

// The same for any samples.
Sums look_closely(const Direction at, const Samples of, const Place place, const Wall wall, const F error_of_one)
{
    Sums sums = {0};
    for (int k = 0; k < of.count; ++k) {
        const F raw = raw_of(of, k);
        const Expected expected = expect(at, place, wall, of, k);
        add_closely(
            &sums, of, k, raw, expected.light, expected.inside, expected.inside, error_of_one, expected.u1, expected.u2,
            expected.u3);
        sums.within += expected.inside & whole_of(raw) & 1;
    }
    return sums;
}

__kernel void normals_wall(
    ARGUMENTS, __global const float *restrict wall_numbers, const int inverse_length, const int curve_length,
    const int follows)
{
    GATHER_ARGUMENTS
    const Wall wall = {wall_numbers, inverse_length, curve_length, follows, cos_tilt, sin_tilt};
    for (int p = first; p < end; p += LANES) {
        const Samples of = SAMPLES((F)wall.is[DARKEST], (F)wall.is[LIGHTEST]);
        const Place place = place_of(wall, SCALE(2), SCALE(3), SCALE(4));
        const Summary summary = survey(of, noise);
        const Direction begin = begin_at(of, zenith_of(of, summary.level), place, wall);
        Direction normal = begin;
        Sums sums;
        for (int number = 0; number < STEPS; ++number) {
            sums = look(normal, of, place, wall, summary.wave);
            normal = step(normal, sums);
        }
        const F waves = sums.waves;
        // Too few informative samples give no result, whatever the steps.
        const I irregular = ((summary.usable < count) | (sums.within < count)) & (summary.usable >= LEAST);
        if (any_of(irregular)) {
            normal = blend(normal, begin, irregular);
            I moves = irregular;
            for (int more = 0; more < MORE && any_of(moves); ++more) {
                const Sums closer = look_closely(normal, of, place, wall, summary.error_of_one);
                sums = blend_sums(sums, closer, moves);
                moves = move(&normal, step(normal, closer), moves);
            }
        }
        const I usable = LESSER(summary.usable, sums.within), at_rest = normal.st < limits.rest;
        const F model = limits.model * (1.0f / count) * sums.m11;
        conclude(maps, p, turns, normal, sums, summary.error_of_one, count, usable, at_rest, limits, model);
        if (!bare) keep_wave(maps, p, turns, of, summary.wave, waves);
    }
}
