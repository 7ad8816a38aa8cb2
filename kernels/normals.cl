// Surface normals from the samples of one turn of axial rotation. Specification: normals.py, normals_wall.py.
//
// FRAME    type of a sample
// COUNTED  1 where samples are whole counts, clipped at 0 and at TOP; 0 where they are floats, of which NaN is missing
// TOP      the largest count
// LANES    pixels side by side in a vector: 8 or 4
// WORDS    vectors of one work-item
// COUNT    frames of the turn
// ROOM     frames that each of `tables` has room for
// WEIGHTED 1 where frames have weights of their own
// MAPS     1 where each pixel has a scale of its own, 0 where `scale` holds one for all
// ENDS     1 where brightness is linear between some zeniths only
// RING     1 where the stack is a ring of COUNT frames, each of `stride` samples, in which the turn goes round
// BARE     1 where the wave's maps are not wanted
// MORE     Gauss-Newton steps after the first two, for pixels of which a sample is clipped, missing or out of range
// WALL     1 where samples are lights that come from a cylindrical wall, not zeniths; unset otherwise. Then there are
// STEPS    Gauss-Newton steps of all pixels
// CURVE    numbers of the light's curve
// INVERSE  numbers of its inverse
// FOLLOWS  1 where a pixel keeps seeing one point of the object
//
// Angles are radians. Maps lie in planes of `stride` pixels, whole vectors, of which the first `pixels` are the
// picture's:
//
// stack    `pixels` samples of each frame, one frame after the other; the turn begins with frame `start`
// tables   of several turns, of which `table` is this one's: planes of ROOM frames: cosine and sine of the phase, root of
//          the weight, shares in mean, cosine and sine
// scale    counts at zenith 0; radians per count; the zeniths between which brightness is linear. Under a wall: counts
//          without light; light per count; x and y from the wall's axis, and z
// vectors  x, y and z of each pixel side by side
//
// All maps but those are answers; of the second turn on they are joined with those of the `turns` - 1 before.

#include "common.clh"
typedef JOIN(FRAME, LANES) Raw;
typedef JOIN(float, LANES) F;
typedef JOIN(int, LANES) I;
typedef JOIN(uchar, LANES) B;
#define AS_F(x) JOIN(as_float, LANES)(x)
#define AS_I(x) JOIN(as_int, LANES)(x)

// A frame begins anywhere, so its vectors are not aligned.
typedef struct __attribute__((packed)) { Raw samples; } Stored;
#define LOAD(k) JOIN(convert_float, LANES)(((__global const Stored *)(frames + PLACE(k) + p))->samples)
#if RING
#define PLACE(k) (size_t)(begins + (k) - (begins + (k) < COUNT ? 0 : COUNT)) * each
#define FRAMES const int begins = start, each = stride; __global const FRAME *frames = stack
#else
#define PLACE(k) (size_t)(k) * each
#define FRAMES const int begins = 0, each = pixels; __global const FRAME *frames = stack + (size_t)start * pixels
#endif
#define READ(map, at) (*(__global const F *)((map) + (at)))
#define STORE(map, at, values) (*(__global F *)((map) + (at)) = (values))
#if MAPS
#define SCALE(plane) READ(scale, (long)(plane) * stride + p)
#else
#define SCALE(plane) ((F)scale[plane])
#endif

#if COUNTED
#define WHOLE(raw) ((raw > 0.0f) & (raw < TOP))
#define PRESENT(raw) raw
#define PRESENT_COUNT ((float)COUNT)
#else
#define WHOLE(raw) (raw == raw)
#define PRESENT(raw) (raw == raw ? raw : (F)0.0f)
#define PRESENT_COUNT JOIN(convert_float, LANES)(whole)
#endif

#define COSINE(k) turn[k]
#define SINE(k) turn[ROOM + (k)]
#if WEIGHTED
#define ROOT_WEIGHT(k) turn[2 * ROOM + (k)]
#define WEIGH(x, k) ((x) * ROOT_WEIGHT(k))
#else
#define WEIGH(x, k) (x)
#endif
#define IN_MEAN(k) turn[3 * ROOM + (k)]
#define IN_COSINE(k) turn[4 * ROOM + (k)]
#define IN_SINE(k) turn[5 * ROOM + (k)]

#if LANES == 8
#define ANY(flags) any4((flags).lo | (flags).hi)
#else
#define ANY(flags) any4(flags)
#endif

#define FREEDOM (COUNT - 3)
#define REACH 0.25f     // longest step, radians
#define NO_ANSWER 1.0f  // a standard error, radians, from which on nothing is known
#define STEADY 1e-6f    // amplitude, radians, up to which rounding makes the azimuth
#define SETTLED 1e-12f  // square of a step, radians, after which the next ones are none
#define LEAST 3         // samples that must be there and within their range
#define MARGIN 3.0f     // standard deviations that a sample must be from the ends of a range to be within it

typedef struct { F ct, st, cp, sp; } Direction;  // cosine and sine of zenith and azimuth
typedef struct { F mean, cosine, sine; } Wave;   // of a pixel's zeniths over the turn
#if WALL
// The point that a pixel sees in the mean pose, by how much its line of sight moves for each mm of z, and that for each mm
// from the axis.
typedef struct { F x, y, z, slope_x, slope_y, bend; } Place;
#define SCENE , const Place place, __global const float *wall
#define HERE , place, wall
#else
#define SCENE
#define HERE
#endif
typedef struct {
    F m11, m12, m22, b1, b2;  // normal equations of the direction: along the meridian, and across
    F m13, m23, m33, b3;      // and of the tilt
    F square, waves;          // sums of the squares of what the direction leaves, and of what the wave leaves
#if WALL
    I within;                 // samples that are whole, and expected within range
#endif
} Sums;

#if defined(__AVX__) && defined(__has_builtin)
#if __has_builtin(__builtin_ia32_rsqrtps256)
#define FAST_GUESS 1
#endif
#endif

int any4(const int4 flags)
{
    const int2 pair = flags.lo | flags.hi;
    return (pair.x | pair.y) != 0;
}

// To 5e-7 of itself, by Newton's steps after a guess: the processor's own, where it has one, for the library's root is a call
// in PoCL; else one from the exponent, with Kadlec's constants.
F inverse_roots(const F x)
{
#if LANES != 8
    return rsqrt(x);
#elif FAST_GUESS
    const F y = __builtin_ia32_rsqrtps256(x);
    return y * (1.5f - 0.5f * x * y * y);
#else
    F y = AS_F(0x5F1FFFF9 - (AS_I(x) >> 1));
    y *= 0.703952253f * (2.38924456f - x * y * y);
    return y * (1.50000036f - 0.5f * x * y * y);
#endif
}

F roots(const F x) { return x * inverse_roots(GREATER(x, (F)1e-30f)); }

F cosine(const F angle)
{
    const F y = LESSER(angle * angle, (F)4.0f);
    return 0.99999999f + y * (-0.49999991f + y * (0.041666440f + y * (-0.0013886607f
        + y * (2.4693838e-5f - y * 2.5153292e-7f))));
}

F sine(const F angle)
{
    const F y = LESSER(angle * angle, (F)4.0f);
    return angle * (0.999999999f + y * (-0.16666666f + y * (0.0083333157f + y * (-0.000198394995f
        + y * (2.74738174e-6f - y * 2.31926769e-8f)))));
}

// An angle by half its sine, to 2e-7, of x = sin^2(angle / 2) up to 0.45 and to 2e-5 up to 0.5; in pairs, so that one
// need not wait for the other.
F angle_by_half_sine(const F x)
{
    const F y = x * x;
    return (1.99999977f + x * 1.33340033f) + y * ((1.06356538f + x * 0.968005666f)
        + y * ((0.36618433f + x * 2.68428173f) + y * (-3.71582798f + x * 5.02326723f)));
}

Direction direction_of(const F x, const F y, const F z)
{
    const F flat = x * x + y * y, inverse = inverse_roots(flat + z * z);
    const I level = flat < 1e-20f;
    const F across = inverse_roots(level ? (F)1.0f : flat);
    Direction found;
    found.ct = z * inverse;
    found.st = level ? (F)0.0f : flat * across * inverse;
    found.cp = level ? (F)1.0f : x * across;
    found.sp = level ? (F)0.0f : y * across;
    return found;
}

#if WALL
#define RADIUS wall[0]
#define RIM wall[1]
#define SCATTER wall[2]  // square of the sine of its half-angle
#define BEND wall[3]
#define BEND_SQUARE wall[4]
#define LAMP_X wall[5]   // by the radius, as LAMP_Y
#define LAMP_Y wall[6]
#define NEAREST wall[7]  // the q between which the curve holds
#define FURTHEST wall[8]
#define DARKEST wall[9]  // and the lights
#define LIGHTEST wall[10]
#define SENSE wall[11]   // 1 where steeper is brighter, -1 where it is darker
#define PIVOT_X wall[12]
#define PIVOT_Y wall[13]
#define PIVOT_Z wall[14]
#define MIDDLE wall[15]  // what q is counted from in the curve, and how often
#define PER_Q wall[16]
#define OF_INVERSE(i) wall[17 + (i)]
#define OF_CURVE(i) wall[17 + INVERSE + (i)]

// The light of each sample and its derivatives; see response.py. The normal and the point turn with the body first: along
// the phase's direction and up only. The line of sight need not be a unit vector.
#define PREPARE const F nx = at.st * at.cp, ny = at.st * at.sp, nz = at.ct;
#define SEE(k)                                                                                   \
    const float c = COSINE(k), s = SINE(k);                                                      \
    const F flat_n = nx * c + ny * s, out_n = flat_n * cos_tilt + nz * sin_tilt;                 \
    const F bz = nz * cos_tilt - flat_n * sin_tilt, bx = nx + c * (out_n - flat_n), by = ny + s * (out_n - flat_n); \
    const F out_p = (place.x - PIVOT_X) * c + (place.y - PIVOT_Y) * s, up_p = place.z - PIVOT_Z; \
    const F pz = PIVOT_Z + up_p * cos_tilt - out_p * sin_tilt;
#if FOLLOWS
#define STAND                                                                                    \
    const F shift = out_p * (cos_tilt - 1.0f) + up_p * sin_tilt;                                 \
    const F px = place.x + c * shift, sx = place.slope_x - place.bend * c * shift;               \
    const F py = place.y + s * shift, sy = place.slope_y - place.bend * s * shift;
#else
#define STAND                                                                                    \
    const F sx = place.slope_x, px = place.x + (pz - place.z) * sx;                               \
    const F sy = place.slope_y, py = place.y + (pz - place.z) * sy;
#endif
#define MIRROR                                                                                   \
    const F facing = sx * bx + sy * by + bz, twice = facing + facing;                            \
    const F rx = twice * bx - sx, ry = twice * by - sy, rz = twice * bz - 1.0f, flat = rx * rx + ry * ry; \
    const F room = RADIUS * RADIUS - px * px - py * py, along = px * rx + py * ry;               \
    const F square = along * along + flat * room, per_leave = inverse_roots(square);              \
    const F way = room / (along + square * per_leave);                                           \
    const F mx = px + way * rx, my = py + way * ry, h = pz + way * rz;                            \
    const F far = h * h + RADIUS * RADIUS, per_far = inverse_roots(far), per_both = 1.0f / (far * per_far + RADIUS); \
    const F q = h * per_both, least_q = GREATER(q, (F)NEAREST), held = LESSER(least_q, (F)FURTHEST); \
    F level = OF_CURVE(CURVE - 1), steep = 0.0f;                                                 \
    const F place_q = (held - MIDDLE) * PER_Q;                                                   \
    for (int i = CURVE - 2; i >= 0; --i) {                                                       \
        steep = steep * place_q + level;                                                         \
        level = level * place_q + OF_CURVE(i);                                                   \
    }                                                                                            \
    steep *= PER_Q;                                                                              \
    level += steep * (q - held);
#define DERIVE(k)                                                                                \
    const F lamp = 1.0f + LAMP_X * mx + LAMP_Y * my, zenith = lamp * level;                      \
    const F by_height = lamp * steep * (RADIUS * per_far * per_both);                            \
    const F further = (level * (LAMP_X * rx + LAMP_Y * ry) + by_height * rz) * per_leave;        \
    const F gx = way * (level * LAMP_X - further * mx), gy = way * (level * LAMP_Y - further * my), gz = way * by_height; \
    const F pull_n = gx * bx + gy * by + gz * bz;                                                \
    const F vx = 2.0f * (facing * gx + pull_n * sx), vy = 2.0f * (facing * gy + pull_n * sy);    \
    const F vz = 2.0f * (facing * gz + pull_n), flat_v = vx * c + vy * s;                        \
    const F back = flat_v * cos_tilt - vz * sin_tilt - flat_v;                                   \
    const F wx = vx + c * back, wy = vy + s * back, wz = flat_v * sin_tilt + vz * cos_tilt;      \
    const F u1 = WEIGH(at.ct * (at.cp * wx + at.sp * wy) - at.st * wz, k);                       \
    const F u2 = WEIGH(at.cp * wy - at.sp * wx, k), u3 = WEIGH(flat_v * bz - vz * out_n, k);
// Whether the rays that are turned up and down by the scatter meet the wall, too: by the sines of the angles to its edges.
#define EXPECT                                                                                   \
    const F below = RIM - h, over = RIM - pz, apart = way * way * flat;                           \
    const F turned = SCATTER * (sx * sx + sy * sy + 1.0f);                                       \
    const I inside = (q == held) & (below >= 0.0f) & (h >= 0.0f)                                 \
        & (flat * below * below >= turned * (apart + over * over)) & (flat * h * h >= turned * (apart + pz * pz));
#define PREDICT(k) SEE(k) STAND MIRROR DERIVE(k) EXPECT
#define COUNT_INSIDE(flags) sums.within -= (flags);
#define COUNT_LAST if (last) COUNT_INSIDE(inside)
#define LAST , const int last
#else
#define COUNT_INSIDE(flags)
#define COUNT_LAST
#define LAST

// Half the sine of a zenith is root(x - x^2), of x = sin^2(zenith / 2); and x is base + lean cos(azimuth - phase), which
// loses no digits that matter. By u1, u2 and u3 a zenith grows along the meridian, across it and with the tilt; all are
// divided by the standard deviation of a sample of its weight, in those of weight 1.
#define PREPARE                                                                                  \
    const F apart = at.st * cos_tilt - at.ct * sin_tilt, lean = 0.5f * sin_tilt * at.st;         \
    const F base = lean + apart * apart / (2.0f + 2.0f * (at.ct * cos_tilt + at.st * sin_tilt)); \
    const F high_part = 0.5f * cos_tilt * at.st, low_part = 0.5f * sin_tilt * at.ct;             \
    const F beside_x = 0.5f * sin_tilt * at.cp, beside_y = 0.5f * sin_tilt * at.sp;
#define PREDICT(k)                                                                               \
    const F near = at.cp * COSINE(k) + at.sp * SINE(k), beside = beside_x * SINE(k) - beside_y * COSINE(k); \
    const F most = LESSER(base + lean * near, (F)0.5f), x = GREATER(most, (F)1e-12f);            \
    const F rest = x - x * x, inverse = inverse_roots(rest);                                      \
    const F zenith = rest * inverse * angle_by_half_sine(x), by_sine = WEIGH(inverse, k); \
    const F u1 = (low_part * near + high_part) * by_sine, u2 = beside * by_sine;                 \
    const F u3 = (high_part * near + low_part) * by_sine;
#endif

#define ADD_DERIVATIVES(v1, v2, v3)                                                              \
    sums.m11 += v1 * u1; sums.m12 += v1 * u2; sums.m22 += v2 * u2;                               \
    sums.m13 += v1 * u3; sums.m23 += v2 * u3; sums.m33 += v3 * u3;
#define ADD_RESIDUAL(pull)                                                                       \
    sums.b1 += u1 * (pull); sums.b2 += u2 * (pull); sums.b3 += u3 * (pull);
#define NOTHING {0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f}

F off_wave(const F zenith, const Wave wave, const float cosine, const float sine)
{
    return zenith - wave.mean - cosine * wave.cosine - sine * wave.sine;
}

// The normal equations at a direction, of samples that are all there and all within range.
Sums look(
    const Direction at, const F *zeniths, const Wave wave, __global const float *turn, const float cos_tilt,
    const float sin_tilt SCENE LAST)
{
    Sums sums = NOTHING;
    PREPARE
    for (int k = 0; k < COUNT; ++k) {
        PREDICT(k)
        const F error = WEIGH(zeniths[k] - zenith, k);
        const F off = WEIGH(off_wave(zeniths[k], wave, COSINE(k), SINE(k)), k);
        COUNT_LAST
        ADD_DERIVATIVES(u1, u2, u3)
        ADD_RESIDUAL(error)
        sums.square += error * error;
        sums.waves += off * off;
    }
    return sums;
}

// The normal distribution's density by its integral; the series is good to 2e-4 where it is taken.
F mills(const F z)
{
    const F y = GREATER(z, (F)-6.0f), far = 1.0f / LESSER(z * z, (F)1e30f);
    const F near = 0.797884561f * exp(-0.5f * y * y) / erfc(-0.707106781f * y);
    return z > -6.0f ? near : -z / (1.0f - far * (1.0f - far * (3.0f - 15.0f * far)));
}

// The same of any samples. A clipped one shows only on which side of its bound it was (a Tobit model); one that is
// expected out of range says nothing of the direction, and a missing one nothing at all.
Sums look_closely(
    const Direction at, const F *zeniths, __global const FRAME *frames, const int begins, const int each, const int p,
    __global const float *turn, const float cos_tilt, const float sin_tilt, const F offset, const F per_count,
    const F low, const F high, const F error_of_one SCENE)
{
    Sums sums = NOTHING;
    PREPARE
    for (int k = 0; k < COUNT; ++k) {
        PREDICT(k)
#if WALL
        const F seen = zenith, error = zeniths[k] - seen, raw = LOAD(k);
        COUNT_INSIDE(inside & WHOLE(raw))
#else
        const F least = GREATER(zenith, low), seen = LESSER(least, high), error = zeniths[k] - seen, raw = LOAD(k);
        const I inside = (zenith > low) & (zenith < high);
#endif
        F share = 1.0f, pull = error, misfit = error * error;
#if COUNTED
        const I under = raw <= 0.0f, clipped = under | (raw >= TOP);
        const F end = ((under ? (F)0.5f : (F)(TOP - 0.5f)) - offset) * per_count;
        const F error_of_this = error_of_one * (1.0f / WEIGH(1.0f, k));
        const F side = under == (per_count > 0.0f) ? (F)-1.0f : (F)1.0f, z = side * (seen - end) / error_of_this;
        const F slope = mills(z), beyond = LESSER(z, (F)0.0f) * error_of_this;
        share = clipped ? slope * (slope + z) : share;
        pull = clipped ? side * slope * error_of_this : pull;
        misfit = clipped ? beyond * beyond : misfit;
#else
        const I known = raw == raw;
        share = known ? share : (F)0.0f;
        pull = known ? pull : (F)0.0f;
        misfit = known ? misfit : (F)0.0f;
#endif
#if WALL
        misfit = inside ? misfit : (F)0.0f;
#endif
        share = inside ? share : (F)0.0f;
        pull = WEIGH(inside ? pull : (F)0.0f, k);
        const F v1 = share * u1, v2 = share * u2, v3 = share * u3;
        ADD_DERIVATIVES(v1, v2, v3)
        ADD_RESIDUAL(pull)
        sums.square += WEIGH(WEIGH(misfit, k), k);
    }
    return sums;
}

Direction step(const Direction at, const Sums sums)
{
    const F scale = 1.0f / (sums.m11 * sums.m22 - sums.m12 * sums.m12);
    F along = (sums.m22 * sums.b1 - sums.m12 * sums.b2) * scale;
    F across = (sums.m11 * sums.b2 - sums.m12 * sums.b1) * scale;
    const F length = along * along + across * across, shorter = REACH * REACH / GREATER(length, (F)(REACH * REACH));
    along *= shorter;
    across *= shorter;
    const F out = at.st + along * at.ct;
    return direction_of(out * at.cp - across * at.sp, out * at.sp + across * at.cp, at.ct - along * at.st);
}

// Takes the lanes that are chosen from another.
#define TAKE(field) mine.field = chosen ? other.field : mine.field;

Sums blend_sums(Sums mine, const Sums other, const I chosen)
{
    TAKE(m11) TAKE(m12) TAKE(m22) TAKE(b1) TAKE(b2) TAKE(m13) TAKE(m23) TAKE(m33) TAKE(b3) TAKE(square)
#if WALL
    TAKE(within)
#endif
    return mine;
}

Direction blend(Direction mine, const Direction other, const I chosen)
{
    TAKE(ct) TAKE(st) TAKE(cp) TAKE(sp)
    return mine;
}

#if WALL
// The mean light is that of a place on the wall; the wave gives its azimuth, and so how far it is from here.
Direction begin_at_wall(const F *lights, const F mean, __global const float *turn SCENE)
{
    F x = 0.0f, y = 0.0f, q = OF_INVERSE(INVERSE - 1);
    for (int k = 0; k < COUNT; ++k) {
        const F deviation = lights[k] == lights[k] ? lights[k] - mean : (F)0.0f;
        x += IN_COSINE(k) * deviation;
        y += IN_SINE(k) * deviation;
    }
    const F most = LESSER(mean, (F)LIGHTEST), light = GREATER(most, (F)DARKEST);
    for (int i = INVERSE - 2; i >= 0; --i) q = q * light + OF_INVERSE(i);
    q = q < NEAREST ? (F)NEAREST : q;
    q = q > FURTHEST ? (F)FURTHEST : q;
    const F swing = x * x + y * y;
    const I swings = swing > 0.0f;
    const F inverse = SENSE * inverse_roots(swings ? swing : (F)1.0f);
    x = swings ? x * inverse : (F)1.0f;
    y = swings ? y * inverse : (F)0.0f;
    const F along = place.x * x + place.y * y;
    const F out = roots(along * along + RADIUS * RADIUS - place.x * place.x - place.y * place.y) - along;
    const F rise = 2.0f * RADIUS * q / (1.0f - q * q) - place.z, per_ray = inverse_roots(out * out + rise * rise);
    const F per_sight = inverse_roots(place.slope_x * place.slope_x + place.slope_y * place.slope_y + 1.0f);
    return direction_of(out * x * per_ray + place.slope_x * per_sight, out * y * per_ray + place.slope_y * per_sight,
                        rise * per_ray + per_sight);
}
#endif

// Eq. 10 is linear in the normal once the cosine of the zenith is taken: its wave is the normal. A missing sample is
// taken for the mean of the others.
Direction begin_at(const F *zeniths, __global const float *turn, const float cos_tilt, const float sin_tilt)
{
    F known = 0.0f, sum = 0.0f, x = 0.0f, y = 0.0f, z = 0.0f;
#if !COUNTED
    for (int k = 0; k < COUNT; ++k) {
        const I there = zeniths[k] == zeniths[k];
        known += there ? (F)1.0f : (F)0.0f;
        sum += there ? cosine(zeniths[k]) : (F)0.0f;
    }
#endif
    for (int k = 0; k < COUNT; ++k) {
        F level = cosine(zeniths[k]);
#if !COUNTED
        level = zeniths[k] == zeniths[k] ? level : sum / known;
#endif
        z += IN_MEAN(k) * level;
        x -= IN_COSINE(k) * level;
        y -= IN_SINE(k) * level;
    }
    return direction_of(x * cos_tilt, y * cos_tilt, z * sin_tilt);
}

// The mean, cosine and sine of zeniths (eq. 17-22, as least squares).
Wave fit_wave(const F *zeniths, __global const float *turn)
{
    Wave wave = {0.0f, 0.0f, 0.0f};
    for (int k = 0; k < COUNT; ++k) {
        wave.mean += IN_MEAN(k) * zeniths[k];
        wave.cosine += IN_COSINE(k) * zeniths[k];
        wave.sine += IN_SINE(k) * zeniths[k];
    }
    return wave;
}

// The mean over turns so far, of those that tell something.
#define JOINED(old, now) (now != now ? old : old != old ? now : old + (1.0f / turns) * (now - old))

// What all methods tell beside their normals, in counts; of several turns the mean, and the root mean square.
#if BARE
#define KEEP_WAVE(square)
#else
#define KEEP_WAVE(square)                                                                        \
    {                                                                                            \
        const F gain = 1.0f / per_count, left = (square) * gain * gain;                          \
        F now_mean = offset + wave.mean * gain, now_cosine = wave.cosine * gain, now_sine = wave.sine * gain; \
        F now_left = left / (FREEDOM > 0 ? FREEDOM : NAN);                                       \
        if (turns > 1) {                                                                         \
            const F before = READ(residual, p);                                                  \
            now_mean = JOINED(READ(mean, p), now_mean);                                          \
            now_cosine = JOINED(READ(cosines, p), now_cosine);                                   \
            now_sine = JOINED(READ(sines, p), now_sine);                                         \
            now_left = JOINED(before * before, now_left);                                        \
        }                                                                                        \
        STORE(mean, p, now_mean);                                                                \
        STORE(cosines, p, now_cosine);                                                           \
        STORE(sines, p, now_sine);                                                               \
        STORE(residual, p, roots(now_left));                                                      \
    }
#endif

#if LANES == 8
#define KEEP_VECTORS(x, y, z)                                                                    \
    STORE(vectors, 3L * p, ((F)(x.s0, y.s0, z.s0, x.s1, y.s1, z.s1, x.s2, y.s2)));                \
    STORE(vectors, 3L * p + 8, ((F)(z.s2, x.s3, y.s3, z.s3, x.s4, y.s4, z.s4, x.s5)));            \
    STORE(vectors, 3L * p + 16, ((F)(y.s5, z.s5, x.s6, y.s6, z.s6, x.s7, y.s7, z.s7)));
#define READ_VECTORS(x, y, z)                                                                    \
    {                                                                                            \
        const F a = READ(vectors, 3L * p), b = READ(vectors, 3L * p + 8), c = READ(vectors, 3L * p + 16); \
        x = (F)(a.s0, a.s3, a.s6, b.s1, b.s4, b.s7, c.s2, c.s5);                                 \
        y = (F)(a.s1, a.s4, a.s7, b.s2, b.s5, c.s0, c.s3, c.s6);                                 \
        z = (F)(a.s2, a.s5, b.s0, b.s3, b.s6, c.s1, c.s4, c.s7);                                 \
    }
#else
#define KEEP_VECTORS(x, y, z)                                                                    \
    STORE(vectors, 3L * p, ((F)(x.s0, y.s0, z.s0, x.s1)));                                        \
    STORE(vectors, 3L * p + 4, ((F)(y.s1, z.s1, x.s2, y.s2)));                                    \
    STORE(vectors, 3L * p + 8, ((F)(z.s2, x.s3, y.s3, z.s3)));
#define READ_VECTORS(x, y, z)                                                                    \
    {                                                                                            \
        const F a = READ(vectors, 3L * p), b = READ(vectors, 3L * p + 4), c = READ(vectors, 3L * p + 8); \
        x = (F)(a.s0, a.s3, b.s2, c.s1);                                                         \
        y = (F)(a.s1, b.s0, b.s3, c.s2);                                                         \
        z = (F)(a.s2, b.s1, c.s0, c.s3);                                                         \
    }
#endif

// Of several turns, the mean of the normals weighted by the inverse of their variances, and contact in all of them.
#define KEEP_ANSWER(answered, x, y, z, error, touches)                                           \
    {                                                                                            \
        F nx = (answered) ? (x) : (F)NAN, ny = (answered) ? (y) : (F)NAN, nz = (answered) ? (z) : (F)NAN; \
        F now = (answered) ? (error) : (F)NAN;                                                   \
        B flags = JOIN(convert_uchar, LANES)((answered) & (touches) & 1);                        \
        if (turns > 1) {                                                                         \
            F ox, oy, oz;                                                                        \
            READ_VECTORS(ox, oy, oz)                                                             \
            const F before = READ(sigma, p);                                                     \
            const I old = before == before, new = now == now;                                    \
            const F own = new ? 1.0f / (now * now) : (F)0.0f, theirs = old ? 1.0f / (before * before) : (F)0.0f; \
            nx = own * (new ? nx : (F)0.0f) + theirs * (old ? ox : (F)0.0f);                     \
            ny = own * (new ? ny : (F)0.0f) + theirs * (old ? oy : (F)0.0f);                     \
            nz = own * (new ? nz : (F)0.0f) + theirs * (old ? oz : (F)0.0f);                     \
            const F length = inverse_roots(nx * nx + ny * ny + nz * nz);                          \
            nx = old | new ? nx * length : (F)NAN;                                               \
            ny = old | new ? ny * length : (F)NAN;                                               \
            nz = old | new ? nz * length : (F)NAN;                                               \
            now = old | new ? inverse_roots(own + theirs) : (F)NAN;                               \
            flags &= *(__global const B *)(contact + p);                                         \
        }                                                                                        \
        KEEP_VECTORS(nx, ny, nz)                                                                 \
        STORE(sigma, p, now);                                                                    \
        *(__global B *)(contact + p) = flags;                                                    \
    }

// Whether a sum of squares is that of noise and of what the model leaves out.
#define LIKE_NOISE(square, model) (FREEDOM > 0 ? (square) <= noise_limit * error_of_one * error_of_one + (model) : (I)-1)

// A sheet at rest shows the zenith 0 all the time; one in contact a mean of the tilt or more.
#define AT_REST (wave.mean < rest_below)

#if WALL
#define WALL_ARGUMENT MAP wall,
#else
#define WALL_ARGUMENT
#endif
#define ARGUMENTS                                                                                \
    __global const FRAME *restrict stack, MAP tables,                 \
    MAP scale, WALL_ARGUMENT const int table, const int start, const int pixels, const int stride, const int turns, const float cos_tilt,               \
    const float sin_tilt, const float noise_base, const float noise_slope, const float noise_least, \
    const float noise_limit, const float limit, const float still_below, const float wild_above, const float rest_below,                         \
    OUT vectors, OUT sigma,                            \
    __global uchar *restrict contact, OUT mean,                             \
    OUT cosines, OUT sines,                            \
    OUT residual

#define EACH_VECTOR                                                                              \
    FRAMES;                                                                                      \
    MAP turn = tables + (size_t)table * 6 * ROOM;                     \
    const int first = (int)get_global_id(0) * WORDS * LANES;                                     \
    for (int p = first; p < LESSER(first + WORDS * LANES, pixels); p += LANES)

#if ENDS || WALL
#define COUNT_WITHIN                                                                             \
    I usable = 0;                                                                                 \
    for (int k = 0; k < COUNT; ++k) {                                                            \
        const F margin = MARGIN * error_of_one * (1.0f / WEIGH(1.0f, k));                        \
        usable -= (zeniths[k] > low + margin) & (zeniths[k] < high - margin) & WHOLE(LOAD(k));    \
    }
#else
#define COUNT_WITHIN const I usable = whole;
#endif
#if WALL
#define READ_ENDS                                                                                \
    const F pixel_x = SCALE(2), pixel_y = SCALE(3), z = SCALE(4), low = DARKEST, high = LIGHTEST; \
    const F bend = BEND + BEND_SQUARE * (pixel_x * pixel_x + pixel_y * pixel_y);                 \
    const Place place = {pixel_x * (1.0f - z * bend), pixel_y * (1.0f - z * bend), z, -bend * pixel_x, -bend * pixel_y, bend};
#else
#define READ_ENDS const F low = SCALE(2), high = SCALE(3);
#endif
#define READ_ZENITHS                                                                             \
    const F offset = SCALE(0), per_count = SCALE(1);                                             \
    READ_ENDS                                                                                    \
    F zeniths[COUNT], sum = 0.0f;                                                                 \
    I whole = 0;                                                                                 \
    for (int k = 0; k < COUNT; ++k) {                                                            \
        const F raw = LOAD(k);                                                                   \
        const I there = WHOLE(raw);                                                              \
        zeniths[k] = (raw - offset) * per_count;                                                 \
        sum += PRESENT(raw);                                                                     \
        whole -= there;                                                                          \
    }                                                                                            \
    const F level = sum / PRESENT_COUNT, variance = noise_base + noise_slope * level;            \
    const F error_of_one = roots(GREATER(variance, (F)noise_least)) * GREATER(per_count, -per_count); \
    COUNT_WITHIN                                                                                 \
    const Wave wave = fit_wave(zeniths, turn);

// With the tilt free as well, what remains of the residuals is noise, or a loss of contact.
#define CONCLUDE(usable, at_rest, model)                                                          \
    const F det = sums.m11 * sums.m22 - sums.m12 * sums.m12, scaled = 1.0f / det;                \
    const F error = error_of_one * roots((sums.m11 + sums.m22) * GREATER(scaled, (F)0.0f));       \
    const I answered = (usable >= LEAST) & (det > 0.0f) & (error < NO_ANSWER) & (found.ct > 0.0f); \
    const F d1 = (sums.m22 * sums.b1 - sums.m12 * sums.b2) * scaled;                             \
    const F d2 = (sums.m11 * sums.b2 - sums.m12 * sums.b1) * scaled;                             \
    const F w1 = (sums.m22 * sums.m13 - sums.m12 * sums.m23) * scaled;                           \
    const F w2 = (sums.m11 * sums.m23 - sums.m12 * sums.m13) * scaled;                           \
    const F information = GREATER(sums.m33 - sums.m13 * w1 - sums.m23 * w2, (F)1e-12f);                 \
    const F pull = sums.b3 - sums.m13 * d1 - sums.m23 * d2, more_tilt = pull / information;             \
    const F remainder = sums.square - sums.b1 * d1 - sums.b2 * d2 - pull * more_tilt;                 \
    const F uncertainty = 3.0f * error_of_one * inverse_roots(information);                                    \
    const I off_tilt = at_rest | (more_tilt + uncertainty < still_below) | (more_tilt - uncertainty > wild_above); \
    KEEP_ANSWER(answered, found.st * found.cp, found.st * found.sp, found.ct, error, LIKE_NOISE(remainder, model) & ~off_tilt)

#if WALL
// Where too few samples tell anything, there is no answer, however closely one looks.
__kernel void normals_wall(ARGUMENTS)
{
    EACH_VECTOR {
        READ_ZENITHS
        const Direction begin = begin_at_wall(zeniths, (level - offset) * per_count, turn HERE);
        Direction found = begin;
        for (int number = 1; number < STEPS; ++number)
            found = step(found, look(found, zeniths, wave, turn, cos_tilt, sin_tilt HERE, 0));
        Sums sums = look(found, zeniths, wave, turn, cos_tilt, sin_tilt HERE, 1);
        const F waves = sums.waves;
        found = step(found, sums);
        const I irregular = ((usable < COUNT) | (sums.within < COUNT)) & (usable >= LEAST);
        if (ANY(irregular)) {
            Direction at = begin;
            for (int more = 0; more < MORE; ++more) {
                const Sums closer = look_closely(at, zeniths, frames, begins, each, p, turn, cos_tilt, sin_tilt,
                                                 offset, per_count, low, high, error_of_one HERE);
                sums = blend_sums(sums, closer, irregular);
                const Direction before = at;
                at = step(at, closer);
                const F along = at.ct - before.ct, x = at.st * at.cp - before.st * before.cp;
                const F y = at.st * at.sp - before.st * before.sp;
                if (!ANY(irregular & (along * along + x * x + y * y > SETTLED))) break;
            }
            found = blend(found, at, irregular);
        }
        const I known = LESSER(usable, sums.within);
        CONCLUDE(known, (found.st < rest_below), limit * (1.0f / COUNT) * sums.m11)
        KEEP_WAVE(waves)
    }
}
#else
__kernel void normals_exact(ARGUMENTS)
{
    EACH_VECTOR {
        READ_ZENITHS
        const Direction begin = begin_at(zeniths, turn, cos_tilt, sin_tilt);
        Sums sums = look(begin, zeniths, wave, turn, cos_tilt, sin_tilt);
        const Direction nearer = step(begin, sums);
        sums = look(nearer, zeniths, wave, turn, cos_tilt, sin_tilt);
        const F waves = sums.waves;
        Direction found = step(nearer, sums);
        // Where too few samples tell anything, there is no answer, however closely one looks.
        const I irregular = (usable < COUNT) & (usable >= LEAST);
        if (ANY(irregular)) {
            Direction at = begin;
            for (int more = 0; more < MORE; ++more) {
                const Sums closer = look_closely(at, zeniths, frames, begins, each, p, turn, cos_tilt, sin_tilt,
                                                 offset, per_count, low, high, error_of_one);
                sums = blend_sums(sums, closer, irregular);
                at = step(at, closer);
            }
            found = blend(found, at, irregular);
        }
        CONCLUDE(usable, AT_REST, limit)
        KEEP_WAVE(waves)
    }
}

// Last come the variances of the wave's mean and cosine, the covariance of cosine and sine, and the sine's variance, in
// those of a sample.
__kernel void normals_paper(
    ARGUMENTS, const float of_mean, const float of_cosine, const float of_both, const float of_sine)
{
    EACH_VECTOR {
        READ_ZENITHS
        F waves = 0.0f;
        for (int k = 0; k < COUNT; ++k) {
            const F off = off_wave(zeniths[k], wave, COSINE(k), SINE(k));
            waves += WEIGH(WEIGH(off * off, k), k);
        }
        const F swing = wave.cosine * wave.cosine + wave.sine * wave.sine;
        const I swings = swing > STEADY * STEADY;
        const F inverse = inverse_roots(swings ? swing : (F)1.0f);
        const F cp = swings ? wave.cosine * inverse : (F)1.0f, sp = swings ? wave.sine * inverse : (F)0.0f;
        const F st = sine(wave.mean), ct = cosine(wave.mean), slant = st * inverse, both = 2.0f * cp * sp * of_both;
        const F across = sp * sp * of_cosine - both + cp * cp * of_sine;
        const F along = cp * cp * of_cosine + both + sp * sp * of_sine;
        const F error = error_of_one * roots(of_mean + slant * slant * across);
        const I answered = swings & (ct > 0.0f);
        const F swung = swing * inverse, uncertainty = 3.0f * error_of_one * roots(along);
        const I off_tilt = AT_REST | (swung + uncertainty < still_below) | (swung - uncertainty > wild_above);
        KEEP_ANSWER(answered, st * cp, st * sp, ct, error, LIKE_NOISE(waves, limit) & ~off_tilt)
        KEEP_WAVE(waves)
    }
}
#endif
