// Surface normals from the samples of one turn of axial rotation. Specification: normals.py; macros and arguments:
// normals.clh.

#include "normals.clh"

#define PART (TILE / LANES < 4 ? TILE / LANES : 4)  // vectors processed at once
#define STEADY 1e-6f  // amplitude, radians, below which rounding determines the azimuth

// The expected zenith of a sample, and its derivatives along the meridian, across it and with respect to the
// tilt, weighted.
typedef struct { F zenith, u1, u2, u3; } Expected;

// The expected samples for a direction; see `expect`.
typedef struct { Direction at; F base, lean, high, low, beside_x, beside_y; } Pose;

Pose pose_of(const Direction at, const float cos_tilt, const float sin_tilt)
{
    const F apart = at.st * cos_tilt - at.ct * sin_tilt;
    const F part = apart * inverse_roots(2.0f + 2.0f * (at.ct * cos_tilt + at.st * sin_tilt));
    Pose pose;
    pose.at = at;
    pose.lean = 0.5f * sin_tilt * at.st;
    pose.base = pose.lean + part * part;
    pose.high = 0.5f * cos_tilt * at.st;
    pose.low = 0.5f * sin_tilt * at.ct;
    pose.beside_x = 0.5f * sin_tilt * at.cp;
    pose.beside_y = 0.5f * sin_tilt * at.sp;
    return pose;
}

// Half the sine of a zenith is root(x - x^2) with x = sin^2(zenith / 2); x is base + lean cos(azimuth -
// phase), which loses no significant digits.
Expected expect(const Pose pose, const Samples of, const int k)
{
    const float c = entry(of, COSINE, k), s = entry(of, SINE, k);
    const F near = pose.at.cp * c + pose.at.sp * s, limited = LESSER(pose.base + pose.lean * near, (F)0.5f);
    const F x = GREATER(limited, (F)1e-12f), rest = x - x * x, inverse = inverse_roots(rest);
    const F by_sine = entry(of, ROOT_WEIGHT, k) * inverse;
    Expected expected;
    expected.zenith = rest * inverse * angle_by_half_sine(x);
    expected.u1 = (pose.low * near + pose.high) * by_sine;
    expected.u2 = (pose.beside_x * s - pose.beside_y * c) * by_sine;
    expected.u3 = (pose.high * near + pose.low) * by_sine;
    return expected;
}

// Eq. 10 is linear in the normal for the cosine of the zenith: its wave is the normal. A missing sample is
// replaced by the mean of the others.
INLINE Direction begin_at(const Samples of, const I usable, const float cos_tilt, const float sin_tilt)
{
    F mean = 0.0f, x = 0.0f, y = 0.0f, z = 0.0f;
    if (!COUNTED && any_of(usable < of.count)) {
        F present = 0.0f;
        for (int k = 0; k < of.count; ++k) {
            const F zenith = zenith_of(of, raw_of(of, k));
            present += zenith == zenith ? (F)1.0f : (F)0.0f;
            mean += zenith == zenith ? cosine(zenith) : (F)0.0f;
        }
        mean /= present;
    }
    for (int k = 0; k < of.count; ++k) {
        const F zenith = zenith_of(of, raw_of(of, k)), level = zenith == zenith ? cosine(zenith) : mean;
        z += entry(of, IN_MEAN, k) * level;
        x -= entry(of, IN_COSINE, k) * level;
        y -= entry(of, IN_SINE, k) * level;
    }
    return direction_of(x * cos_tilt, y * cos_tilt, z * sin_tilt);
}

// The normal equations at a direction for samples that are all valid and in range; the last ones with the
// tilt. (u1, u2) is a unit vector, and so is (u3, u2) scaled by the share of the tilt in the zenith.
INLINE Sums look(
    const Direction at, const Samples of, const Wave wave, const float weights, const float cos_tilt, const float sin_tilt,
    const int last)
{
    Sums sums = {0};
    const Pose pose = pose_of(at, cos_tilt, sin_tilt);
    for (int k = 0; k < of.count; ++k) {
        const F zenith = zenith_of(of, raw_of(of, k));
        const float root = entry(of, ROOT_WEIGHT, k);
        const Expected expected = expect(pose, of, k);
        const F error = root * (zenith - expected.zenith);
        sums.m12 += expected.u1 * expected.u2;
        sums.m22 += expected.u2 * expected.u2;
        sums.b1 += expected.u1 * error;
        sums.b2 += expected.u2 * error;
        if (!last) continue;
        const F off = off_wave(of, k, zenith, wave);
        sums.m13 += expected.u1 * expected.u3;
        sums.m23 += expected.u2 * expected.u3;
        sums.b3 += expected.u3 * error;
        sums.square += error * error;
        sums.waves += off * off;
    }
    const F wider = at.st * (1.0f / sin_tilt);
    sums.m11 = weights - sums.m22;
    sums.m33 = weights - wider * wider * sums.m22;
    return sums;
}

// The same for any samples.
Sums look_closely(
    const Direction at, const Samples of, const F error_of_one, const float cos_tilt, const float sin_tilt)
{
    Sums sums = {0};
    const Pose pose = pose_of(at, cos_tilt, sin_tilt);
    for (int k = 0; k < of.count; ++k) {
        const Expected expected = expect(pose, of, k);
        const F above_low = GREATER(expected.zenith, of.low);
        const I inside = (expected.zenith > of.low) & (expected.zenith < of.high);
        add_closely(
            &sums, of, k, raw_of(of, k), LESSER(above_low, of.high), inside, (I)-1, error_of_one, expected.u1, expected.u2,
            expected.u3);
    }
    return sums;
}

// Step by step for several vectors at once, so that none waits for its own results.
__kernel void normals_exact(ARGUMENTS)
{
    GATHER_ARGUMENTS
    float weights = 0.0f;
    for (int k = 0; k < count; ++k) {
        const float root = table[ROOT_WEIGHT * ROOM + k];
        weights += root * root;
    }
    for (int from = first; from < end; from += PART * LANES) {
        Samples of[PART];
        Summary summary[PART];
        Direction begin[PART], nearer[PART];
        Sums sums[PART];
        int some = 0;  // whether any pixel may have a result
        for (int i = 0; i < PART; ++i) {
            const int next = from + i * LANES, p = next < end ? next : from;
            of[i] = SAMPLES(SCALE(2), SCALE(3));
            summary[i] = survey(of[i], noise);
            some |= any_of(summary[i].usable >= LEAST);
        }
        if (bare && !some) {
            const F none = 0.0f;
            I had = bare == AGAIN ? 0 : -1;
            for (int p = from; bare == AGAIN && p < LESSER(from + PART * LANES, end); p += LANES) {
                const F error = READ(maps.sigma, p);
                had |= error == error;
            }
            if (!any_of(had)) continue;
            for (int p = from; p < LESSER(from + PART * LANES, end); p += LANES)
                keep_answer(maps, p, turns, (I)0, none, none, none, none, (I)0);
            continue;
        }
        for (int i = 0; i < PART; ++i) begin[i] = begin_at(of[i], summary[i].usable, cos_tilt, sin_tilt);
        for (int i = 0; i < PART; ++i) sums[i] = look(begin[i], of[i], summary[i].wave, weights, cos_tilt, sin_tilt, 0);
        for (int i = 0; i < PART; ++i) nearer[i] = step(begin[i], sums[i]);
        for (int i = 0; i < PART; ++i) sums[i] = look(nearer[i], of[i], summary[i].wave, weights, cos_tilt, sin_tilt, 1);
        for (int i = 0; i < PART; ++i) {
            const int p = from + i * LANES;
            if (p >= end) break;
            const F error_of_one = summary[i].error_of_one, waves = sums[i].waves;
            const I usable = summary[i].usable;
            Direction normal = step(nearer[i], sums[i]);
            // Too few informative samples give no result, whatever the steps.
            const I irregular = (usable < count) & (usable >= LEAST);
            if (any_of(irregular)) {
                normal = blend(normal, begin[i], irregular);
                I moves = irregular;
                for (int more = 0; more < MORE && any_of(moves); ++more) {
                    const Sums closer = look_closely(normal, of[i], error_of_one, cos_tilt, sin_tilt);
                    sums[i] = blend_sums(sums[i], closer, moves);
                    moves = move(&normal, step(normal, closer), moves);
                }
            }
            // A sheet at rest has zenith 0; one in contact has a mean of at least the tilt.
            const I at_rest = summary[i].wave.mean < limits.rest;
            conclude(maps, p, turns, normal, sums[i], error_of_one, count, usable, at_rest, limits, limits.model);
            if (!bare) keep_wave(maps, p, turns, of[i], summary[i].wave, waves);
        }
    }
}

// The last arguments are the variances of the wave's mean and cosine, the covariance of cosine and sine, and
// the variance of the sine, relative to that of a sample.
__kernel void normals_paper(
    ARGUMENTS, const float of_mean, const float of_cosine, const float of_both, const float of_sine)
{
    GATHER_ARGUMENTS
    for (int p = first; p < end; p += LANES) {
        const Samples of = SAMPLES(SCALE(2), SCALE(3));
        const Summary summary = survey(of, noise);
        const Wave wave = summary.wave;
        F waves = 0.0f;
        for (int k = 0; k < count; ++k) {
            const F off = off_wave(of, k, zenith_of(of, raw_of(of, k)), wave);
            waves += off * off;
        }
        const F square = wave.cosine * wave.cosine + wave.sine * wave.sine;
        const I modulated = square > STEADY * STEADY;
        const F inverse = inverse_roots(modulated ? square : (F)1.0f);
        const F cp = modulated ? wave.cosine * inverse : (F)1.0f, sp = modulated ? wave.sine * inverse : (F)0.0f;
        const F st = sine(wave.mean), ct = cosine(wave.mean), slant = st * inverse, both = 2.0f * cp * sp * of_both;
        const F across = sp * sp * of_cosine - both + cp * cp * of_sine;
        const F along = cp * cp * of_cosine + both + sp * sp * of_sine;
        const F error = summary.error_of_one * roots(of_mean + slant * slant * across);
        const I answered = modulated & (ct > 0.0f);
        const F amplitude = square * inverse, uncertainty = 3.0f * summary.error_of_one * roots(along);
        const I off_tilt = (wave.mean < limits.rest) | (amplitude + uncertainty < limits.lowest_tilt)
            | (amplitude - uncertainty > limits.highest_tilt);
        const I touches = like_noise(waves, summary.error_of_one, count, limits.noise, limits.model) & !off_tilt;
        keep_answer(maps, p, turns, answered, st * cp, st * sp, ct, error, touches);
        if (!bare) keep_wave(maps, p, turns, of, wave, waves);
    }
}
