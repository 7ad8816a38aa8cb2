// The lit wall as the camera sees it in the mirror sheet. Specification: wall.py.
//
// TILE     pixels of one work-item: 1 on a GPU, many on a CPU
// OBLIQUE  1 if each pixel has its own line of sight, 0 if all look straight down
// GAP      1 with air between body and wall, 0 if they touch
// TABLE    dependence of the wall's radiance: 0 none, 1 on the height, 2 also on the azimuth
// LAMPS    1 if the lamps are uneven

#include "common.clh"

// pixels whose rays are traced together, so that their data stay in the first cache
#define CHUNK (TILE < 64 ? TILE : 64)

#define TINY 1e-20f
#define LEAST 1e-6f  // inverse of a distance that no ray travels, mm

// The library's root is faster on a GPU.
#if TILE == 1
#define ROUGH_INVERSE_ROOT(x) rsqrt(x)
#define INVERSE_ROOT(x) rsqrt(x)
#else
#define ROUGH_INVERSE_ROOT(x) rough_inverse_root(x)
#define INVERSE_ROOT(x) inverse_root(x)
#endif

// A ray from a point inside a cylinder: its cosine to the side times the radius, and the inverse of its
// length.
float2 leave(
    const float x, const float y, const float ray_x, const float ray_y, const float power, const float per_power)
{
    const float along = x * ray_x + y * ray_y;
    const float square = along * along + (ray_x * ray_x + ray_y * ray_y) * power + TINY;
    const float cosine = square * INVERSE_ROOT(square);
    return (float2)(cosine, (along + cosine) * per_power);
}

#if GAP
// Cosine of a refracted ray to the normal, by Snell's law; 0 for total reflection.
float refracted(const float in, const float index)
{
    const float square = 1 - index * index * (1 - in * in), passing = GREATER(square, TINY);
    return square > 0 ? passing * INVERSE_ROOT(passing) : 0;
}

// Transmitted share of light by Fresnel's equations: the mean of both polarisations.
float passed(const float in, const float out, const float index)
{
    const float across = index * in + out, within = in + index * out, both = across * within;
    return 2 * index * in * out * (across * across + within * within) / (both * both);
}

// Distance of a ray from a cylinder, at the cosine `out` to the normal, to a wider one: `outer` is the
// difference of squares.
float cross_gap(const float out, const float ray_x, const float ray_y, const float radius, const float outer)
{
    const float towards = radius * out, square = towards * towards + (ray_x * ray_x + ray_y * ray_y) * outer + TINY;
    return outer / (towards + square * INVERSE_ROOT(square));
}
#endif

// 1 below the rim, `below` above the height where the ray starts, and above the rest plane, `z` below;
// otherwise 0.
float within_edges(
    const float z, const float below, const float ray_z, const float cosine, const float per_distance,
    const float radius, const float sharpness)
{
    const float edge = below * per_distance, bound = radius * edge;
    const float over = (edge - ray_z) * cosine * ROUGH_INVERSE_ROOT(cosine * cosine + bound * bound);
    const float above = ray_z + z * per_distance;
    const float inside = 0.5f + sharpness * LESSER(over, above);
    return LESSER(GREATER(inside, 0), 1);
}

#if TABLE
// Bilinear between the table's samples; `row` counts from the one before the first.
float look_up(MAP table, const int columns, const float row, const float x, const float y)
{
    const int top = row;
    const float down = row - top;
#if TABLE == 2
    const float turn = columns * (azimuth_of(x, y) * 0.159154943f + 0.5f) + 0.5f;
    const float column = LESSER(turn, columns + 0.5f);
    const int west = column, cell = top * (columns + 2) + west, under = cell + columns + 2;
    const float east = column - west;
    const float upper = table[cell] + east * (table[cell + 1] - table[cell]);
    const float lower = table[under] + east * (table[under + 1] - table[under]);
#else
    const float upper = table[top * (columns + 2)], lower = table[(top + 1) * (columns + 2)];
#endif
    return upper + down * (lower - upper);
}
#endif

__kernel void wall_light(
    const int pixels, const int samples, const int rows, const int columns, MAP sheet, MAP places, MAP rays, MAP table,
    const float radius, const float rim, const float gap, const float index, const float scatter, const float fade,
    const float asymmetry_x, const float asymmetry_y, OUT light)
{
    const int first = get_global_id(0) * TILE, end = min(first + TILE, pixels);
    const float sharpness = fade > 0 ? 1 / fade : 1e30f, slack = tan(scatter + fade), per_radius = 1 / radius;
    const float full = 1.0f / (samples * (1 + sqrt(asymmetry_x * asymmetry_x + asymmetry_y * asymmetry_y)));
#if GAP
    const float outer = (radius + gap) * (radius + gap) - radius * radius;
#endif
#if LAMPS
    const float lamp_x = asymmetry_x / (radius + gap), lamp_y = asymmetry_y / (radius + gap);
#endif
#if TABLE
    const float per_row = rows / rim, last_row = rows + 0.5f;
#endif

    for (int base = first; base < end; base += CHUNK) {
        const int width = min(CHUNK, end - base);
        float x[CHUNK], y[CHUNK], z[CHUNK], power[CHUNK], per_power[CHUNK], total[CHUNK];
        float ray_x[CHUNK], ray_y[CHUNK], ray_z[CHUNK];
        float steep_x[CHUNK], steep_y[CHUNK], steep_z[CHUNK];
        int lit[CHUNK];

        int busy = 0;
        for (int i = 0; i < width; ++i) {
            const int p = base + i;
            z[i] = sheet[p];
            const float slope_x = sheet[pixels + p], slope_y = sheet[2 * pixels + p];
            const float twice = 2 / (1 + slope_x * slope_x + slope_y * slope_y);
#if OBLIQUE
            const float view_x = places[2 * pixels + p], view_y = places[3 * pixels + p];
            const float unit = INVERSE_ROOT(1 + view_x * view_x + view_y * view_y);
            const float onto = twice * unit * (1 - view_x * slope_x - view_y * slope_y);
            x[i] = places[p] + z[i] * view_x;
            y[i] = places[pixels + p] + z[i] * view_y;
            ray_x[i] = -onto * slope_x - unit * view_x;
            ray_y[i] = -onto * slope_y - unit * view_y;
            ray_z[i] = onto - unit;
#else
            x[i] = places[p];
            y[i] = places[pixels + p];
            ray_x[i] = -twice * slope_x;
            ray_y[i] = -twice * slope_y;
            ray_z[i] = twice - 1;
#endif
            const float off = x[i] * x[i] + y[i] * y[i] + TINY, flat = ray_x[i] * ray_x[i] + ray_y[i] * ray_y[i] + TINY;
            const float distance = radius - off * INVERSE_ROOT(off), level = flat * INVERSE_ROOT(flat);
            // Dark without tracing its rays: even the most inclined one passes over the rim of the nearest
            // wall.
            const int over = (level + ray_z[i] * slack) * (rim - z[i]) < distance * (ray_z[i] - level * slack);
            lit[i] = (distance > 0) & !over;
            busy |= lit[i];
            power[i] = lit[i] ? distance * (2 * radius - distance) : radius * radius;
            total[i] = 0;
        }
        if (!busy) {
            for (int i = 0; i < width; ++i) light[base + i] = 0;
            continue;
        }

        for (int i = 0; i < width; ++i) {
            per_power[i] = 1 / power[i];
            const float2 exit = leave(x[i], y[i], ray_x[i], ray_y[i], power[i], per_power[i]);
            const float span = 1 / GREATER(exit.y, LEAST);
            const float up_x = -ray_z[i] * (x[i] + span * ray_x[i]), up_y = -ray_z[i] * (y[i] + span * ray_y[i]);
            const float square = (up_x * up_x + up_y * up_y + exit.x * exit.x) * per_radius * per_radius;
            const float scale = INVERSE_ROOT(square + TINY) * per_radius;
            const int determined = square > 1e-12f;
            steep_x[i] = determined ? up_x * scale : 1;
            steep_y[i] = determined ? up_y * scale : 0;
            steep_z[i] = determined ? exit.x * scale : 0;
        }

        for (int s = 0; s < samples; ++s) {
            const float part = rays[3 * s], part_up = rays[3 * s + 1], part_aside = rays[3 * s + 2];
            for (int i = 0; i < width; ++i) {
                const float aside_x = ray_y[i] * steep_z[i] - ray_z[i] * steep_y[i];
                const float aside_y = ray_z[i] * steep_x[i] - ray_x[i] * steep_z[i];
                const float aside_z = ray_x[i] * steep_y[i] - ray_y[i] * steep_x[i];
                const float to_x = part * ray_x[i] + part_up * steep_x[i] + part_aside * aside_x;
                const float to_y = part * ray_y[i] + part_up * steep_y[i] + part_aside * aside_y;
                const float to_z = part * ray_z[i] + part_up * steep_z[i] + part_aside * aside_z;
                const float2 exit = leave(x[i], y[i], to_x, to_y, power[i], per_power[i]);
                float per_distance = exit.y, transmitted = 1;
#if TABLE || LAMPS || GAP
                float span = 1 / GREATER(per_distance, LEAST);
                float at_x = x[i] + span * to_x, at_y = y[i] + span * to_y;
#endif
#if GAP
                const float in = exit.x * per_radius, out = refracted(in, index);
                const float bend = (out - index * in) * per_radius;
                const float air_x = index * to_x + bend * at_x, air_y = index * to_y + bend * at_y;
                const float more = cross_gap(out, air_x, air_y, radius, outer);
                transmitted = passed(in, out, index);
                at_x += more * air_x;
                at_y += more * air_y;
                span += more * index;  // as long as it rises
                per_distance = 1 / span;
#endif
                transmitted *= within_edges(z[i], rim - z[i], to_z, exit.x, per_distance, radius, sharpness);
#if TABLE
                const float high = z[i] + to_z * span, kept = LESSER(GREATER(high, 0), rim);
                transmitted *= look_up(table, columns, GREATER(last_row - kept * per_row, 0), at_x, at_y);
#endif
#if LAMPS
                transmitted *= 1 + lamp_x * at_x + lamp_y * at_y;
#endif
                total[i] += transmitted;
            }
        }
#if TABLE
        const float wall = full;
#else
        const float wall = full * table[0];
#endif
        for (int i = 0; i < width; ++i) light[base + i] = lit[i] ? total[i] * wall : 0;
    }
}
