// Surface normals from samples at any known poses. Specification: normals_pose.py; macros and arguments: normals.clh.
//
// table    after the planes of a turn: the body's axis in each frame, its derivative with respect to the tilt, and travel
// presses  whether travel differs from frame to frame

#include "normals.clh"

enum { AXIS_X = TURN_PLANES, AXIS_Y, AXIS_Z, LEAN_X, LEAN_Y, LEAN_Z, TRAVEL };

#define AT_REST 4.0f  // standard deviations of a sample up to which it may be that of a sheet at rest
#define STEPS 2  // steps for all pixels
#define NOTHING -1e30f  // travel before all others

typedef struct { F x, y, z; } Vector;  // a unit vector, or for rocking its component in the vertical plane
typedef struct { F zenith, u1, u2, u3; } Expected;

// The samples of a pixel that are deeper than `lost`.
typedef struct { F lost; I usable; } Kept;

Vector vector_of(const Direction at) { return (Vector){at.st * at.cp, at.st * at.sp, at.ct}; }

Vector axis_of(const Samples of, const int k)
{
    return (Vector){entry(of, AXIS_X, k), entry(of, AXIS_Y, k), entry(of, AXIS_Z, k)};
}

F product(const Vector a, const Vector b) { return a.x * b.x + a.y * b.y + a.z * b.z; }

// The greatest travel at which a pixel shows the zenith 0 of a sheet at rest, or the least visible zenith,
// and the number of remaining valid samples in range.
INLINE Kept keep(const Samples of, const Summary summary, const float rest_below, const int presses)
{
    Kept kept = {NOTHING, summary.usable};
    if (!presses) return kept;
    for (int k = 0; k < of.count; ++k) {
        const F raw = raw_of(of, k);
        const F rest_zenith = GREATER(of.low, (F)0.0f) + AT_REST * summary.error_of_one / entry(of, ROOT_WEIGHT, k);
        const I clipped = COUNTED ? (of.per_count > 0.0f ? raw <= 0.0f : raw >= TOP) : (I)0;
        const I resting = (zenith_of(of, raw) < GREATER(rest_zenith, (F)rest_below)) | clipped;
        kept.lost = (resting & (kept.lost < entry(of, TRAVEL, k))) ? (F)entry(of, TRAVEL, k) : kept.lost;
    }
    kept.usable = 0;
    for (int k = 0; k < of.count; ++k) {
        const F raw = raw_of(of, k), zenith = zenith_of(of, raw);
        const F margin = MARGIN * summary.error_of_one / entry(of, ROOT_WEIGHT, k);
        const I inside = (zenith > of.low + margin) & (zenith < of.high - margin) & whole_of(raw);
        kept.usable += inside & (kept.lost < entry(of, TRAVEL, k)) & 1;
    }
    return kept;
}

// Expected value of a sample, from the distance of two unit vectors: twice the half sine.
Expected expect(const Direction at, const Samples of, const int k)
{
    const Vector n = vector_of(at), a = axis_of(of, k), apart = {n.x - a.x, n.y - a.y, n.z - a.z};
    const Vector lean = {entry(of, LEAN_X, k), entry(of, LEAN_Y, k), entry(of, LEAN_Z, k)};
    const F square = 0.25f * product(apart, apart), limited = LESSER(square, (F)0.5f), x = GREATER(limited, (F)1e-12f);
    const F rest = x - x * x, inverse = inverse_roots(rest), by_sine = -0.5f * entry(of, ROOT_WEIGHT, k) * inverse;
    Expected expected;
    expected.zenith = rest * inverse * angle_by_half_sine(x);
    expected.u1 = by_sine * (at.ct * (at.cp * a.x + at.sp * a.y) - at.st * a.z);
    expected.u2 = by_sine * (at.cp * a.y - at.sp * a.x);
    expected.u3 = by_sine * product(lean, n);
    return expected;
}

// The same for the components in a vertical plane, which need not be a unit vector.
Expected expect_part(const Vector part, const Samples of, const int k)
{
    const Vector a = axis_of(of, k), lean = {entry(of, LEAN_X, k), 0.0f, entry(of, LEAN_Z, k)};
    const F square = 0.5f - 0.5f * product(part, a), limited = LESSER(square, (F)0.5f), x = GREATER(limited, (F)1e-12f);
    const F rest = x - x * x, inverse = inverse_roots(rest), by_sine = -0.5f * entry(of, ROOT_WEIGHT, k) * inverse;
    return (Expected){rest * inverse * angle_by_half_sine(x), by_sine * a.x, by_sine * a.z, by_sine * product(lean, part)};
}

// Adds a sample to the normal equations; `closely` for clipped or missing samples.
INLINE void take(Sums *sums, const Samples of, const int k, const Expected expected, const F lost, const F error_of_one,
                 const int closely)
{
    const F raw = raw_of(of, k);
    if (closely) {
        const F above_low = GREATER(expected.zenith, of.low);
        const I in_contact = lost < entry(of, TRAVEL, k);
        const I inside = (expected.zenith > of.low) & (expected.zenith < of.high) & in_contact;
        add_closely(
            sums, of, k, raw, LESSER(above_low, of.high), inside, in_contact, error_of_one, expected.u1, expected.u2,
            expected.u3);
    } else {
        const F error = entry(of, ROOT_WEIGHT, k) * (zenith_of(of, raw) - expected.zenith);
        add(sums, expected.u1, expected.u2, expected.u3, 1.0f, error, error * error);
    }
}

INLINE Sums look(const Direction at, const Samples of, const F lost, const F error_of_one, const int closely)
{
    Sums sums = {0};
    for (int k = 0; k < of.count; ++k) take(&sums, of, k, expect(at, of, k), lost, error_of_one, closely);
    return sums;
}

INLINE Sums look_part(const Vector part, const Samples of, const F lost, const F error_of_one, const int closely)
{
    Sums sums = {0};
    for (int k = 0; k < of.count; ++k) take(&sums, of, k, expect_part(part, of, k), lost, error_of_one, closely);
    return sums;
}

// The cosine of the zenith is linear in the normal: least squares over the valid samples. In a plane, y is 0.
INLINE Vector begin_at(const Samples of, const F lost, const int in_plane)
{
    F xx = 0.0f, xy = 0.0f, xz = 0.0f, yy = 0.0f, yz = 0.0f, zz = 0.0f, bx = 0.0f, by = 0.0f, bz = 0.0f;
    for (int k = 0; k < of.count; ++k) {
        const Vector a = axis_of(of, k);
        const F raw = raw_of(of, k), zenith = zenith_of(of, raw), root = entry(of, ROOT_WEIGHT, k);
        const I usable = whole_of(raw) & (lost < entry(of, TRAVEL, k));
        const F weight = usable ? root * root : (F)0.0f, level = usable ? weight * cosine(zenith) : (F)0.0f;
        xx += weight * a.x * a.x;
        xy += weight * a.x * a.y;
        xz += weight * a.x * a.z;
        yy += weight * a.y * a.y;
        yz += weight * a.y * a.z;
        zz += weight * a.z * a.z;
        bx += level * a.x;
        by += level * a.y;
        bz += level * a.z;
    }
    if (in_plane) yy = 1.0f;
    const F cxx = yy * zz - yz * yz, cxy = xz * yz - xy * zz, cxz = xy * yz - xz * yy;
    const F cyy = xx * zz - xz * xz, cyz = xy * xz - xx * yz, czz = xx * yy - xy * xy;
    const F scale = 1.0f / (xx * cxx + xy * cxy + xz * cxz);
    return (Vector){(cxx * bx + cxy * by + cxz * bz) * scale, (cxy * bx + cyy * by + cyz * bz) * scale,
                    (cxz * bx + cyz * by + czz * bz) * scale};
}

// Limits the length of a component of a unit vector to 1.
Vector within(const Vector part)
{
    const F square = product(part, part), shorter = square > 1.0f ? inverse_roots(square) : (F)1.0f;
    return (Vector){part.x * shorter, 0.0f, part.z * shorter};
}

Vector step_part(const Vector part, const Sums sums)
{
    const F scale = 1.0f / (sums.m11 * sums.m22 - sums.m12 * sums.m12);
    const F d1 = (sums.m22 * sums.b1 - sums.m12 * sums.b2) * scale, d2 = (sums.m11 * sums.b2 - sums.m12 * sums.b1) * scale;
    const F length = d1 * d1 + d2 * d2, shorter = REACH * inverse_roots(GREATER(length, (F)(REACH * REACH)));
    return (Vector){part.x + shorter * d1, 0.0f, part.z + shorter * d2};
}

INLINE F waves_of(const Samples of, const Wave wave)
{
    F waves = 0.0f;
    for (int k = 0; k < of.count; ++k) {
        const F off = off_wave(of, k, zenith_of(of, raw_of(of, k)), wave);
        waves += off * off;
    }
    return waves;
}

__kernel void normals_pose(ARGUMENTS, const int presses)
{
    GATHER_ARGUMENTS
    for (int p = first; p < end; p += LANES) {
        const Samples of = SAMPLES(SCALE(2), SCALE(3));
        const Summary summary = survey(of, noise);
        const Kept kept = keep(of, summary, limits.rest, presses);
        const Vector start = begin_at(of, kept.lost, 0);
        const Direction begin = direction_of(start.x, start.y, start.z);
        Direction normal = begin;
        Sums sums = {0};
        for (int number = 0; number < STEPS; ++number) {
            sums = look(normal, of, kept.lost, summary.error_of_one, 0);
            normal = step(normal, sums);
        }
        const I irregular = (kept.usable < count) & (kept.usable >= LEAST);
        if (any_of(irregular)) {
            Direction at = begin;
            for (int more = 0; more < MORE; ++more) {
                const Sums closer = look(at, of, kept.lost, summary.error_of_one, 1);
                sums = blend_sums(sums, closer, irregular);
                at = step(at, closer);
            }
            normal = blend(normal, at, irregular);
        }
        const I at_rest = presses ? (I)0 : summary.wave.mean < limits.rest;
        const B before = presses && turns > 1 ? *(__global const B *)(contact + p) : (B)0;
        if (presses && turns > 1) *(__global B *)(contact + p) = (B)1;
        conclude(maps, p, turns, normal, sums, summary.error_of_one, count, kept.usable, at_rest, limits, limits.model);
        if (presses && turns > 1) *(__global B *)(contact + p) |= before;
        if (!bare) keep_wave(maps, p, turns, of, summary.wave, waves_of(of, summary.wave));
    }
}

// For several turns the means, weighted by the inverse variances of the slopes.
INLINE void keep_slope(const int p, const int turns, F slope, F error, F zenith, OUT slopes, OUT errors, OUT zeniths)
{
    if (turns > 1) {
        const F before = READ(errors, p), old_slope = READ(slopes, p), old_zenith = READ(zeniths, p);
        const I old = before == before, new = error == error, any = old | new;
        const F new_weight = new ? 1.0f / (error * error) : (F)0.0f, old_weight = old ? 1.0f / (before * before) : (F)0.0f;
        const F all = 1.0f / (new_weight + old_weight);
        slope = ((new ? new_weight * slope : (F)0.0f) + (old ? old_weight * old_slope : (F)0.0f)) * all;
        zenith = ((new ? new_weight * zenith : (F)0.0f) + (old ? old_weight * old_zenith : (F)0.0f)) * all;
        error = any ? roots(all) : (F)NAN;
    }
    STORE(slopes, p, slope);
    STORE(errors, p, error);
    STORE(zeniths, p, zenith);
}

__kernel void normals_rock(ARGUMENTS, const int presses, OUT slopes, OUT slope_errors, OUT zeniths)
{
    GATHER_ARGUMENTS
    for (int p = first; p < end; p += LANES) {
        const Samples of = SAMPLES(SCALE(2), SCALE(3));
        const Summary summary = survey(of, noise);
        const Kept kept = keep(of, summary, limits.rest, presses);
        const Vector begin = begin_at(of, kept.lost, 1);
        Vector part = begin;
        Sums sums = {0};
        for (int number = 0; number < STEPS; ++number) {
            const Vector at = within(part);
            sums = look_part(at, of, kept.lost, summary.error_of_one, 0);
            part = step_part(at, sums);
        }
        const I irregular = (kept.usable < count) & (kept.usable >= LEAST);
        if (any_of(irregular)) {
            Vector at = begin;
            for (int more = 0; more < MORE; ++more) {
                at = within(at);
                const Sums closer = look_part(at, of, kept.lost, summary.error_of_one, 1);
                sums = blend_sums(sums, closer, irregular);
                at = step_part(at, closer);
            }
            part.x = irregular ? at.x : part.x;
            part.z = irregular ? at.z : part.z;
        }
        const F det = sums.m11 * sums.m22 - sums.m12 * sums.m12, scaled = 1.0f / det, per_up = 1.0f / part.z;
        const F slope = -part.x * per_up, across = 1.0f - part.z * part.z;
        const F variance = (sums.m22 - 2.0f * slope * sums.m12 + slope * slope * sums.m11) * scaled * per_up * per_up;
        const F zenith = atan2(roots(GREATER(across, (F)0.0f)), part.z), none = NAN;
        const I at_rest = presses ? (I)0 : summary.wave.mean < limits.rest;
        F remains, error = summary.error_of_one * roots(variance);
        const I answered = (kept.usable >= LEAST) & (det > 0.0f) & (error < NO_ANSWER) & (part.z > 0.0f);
        const I touches = lasts(sums, scaled, summary.error_of_one, count, at_rest, limits, limits.model, &remains);
        error = raise_error(error, remains, summary.error_of_one, count, limits.noise);
        keep_slope(p, turns, answered ? slope : none, answered ? error : none, answered ? zenith : none, slopes, slope_errors,
                   zeniths);
        B flags = WIDE(convert_uchar)(answered & touches & 1);
        if (turns > 1) flags = presses ? flags | *(__global const B *)(contact + p) : flags & *(__global const B *)(contact + p);
        store_vectors(none, none, none, maps.vectors + 3L * p);
        STORE(sigma, p, none);
        *(__global B *)(contact + p) = flags;
        if (!bare) keep_wave(maps, p, turns, of, summary.wave, waves_of(of, summary.wave));
    }
}
