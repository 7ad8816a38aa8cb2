// Where the normal jumps, and where contact ends. Specification: edges.py.
//
// TILE     pixels of one work-item
//
// Maps are (rows, columns). `vectors` holds x, y and z of each pixel side by side; of `jumps`, the first plane tells of a
// pixel and its neighbour to the right, the second of it and the one below.

#define SURELY_LESS 0.99f  // cosine of 8 degrees
#define WIDEST 3  // means of windows: 1 pixel deep and 1 across, then 2 and 3, then 3 and 5

#define EACH_PIXEL                                                                               \
    const int first = (int)get_global_id(0) * TILE;                                              \
    const int all = rows * columns;                                                              \
    for (int p = first; p < (first + TILE < all ? first + TILE : all); ++p)

// A pixel that nearly all of its neighbours contradict is a mistake.
__kernel void edges_clean(__global const uchar *restrict contact, __global uchar *restrict clean, const int rows,
                          const int columns)
{
    EACH_PIXEL {
        const int row = p / columns, column = p % columns;
        int others = 0, known = 0;
        for (int dy = -1; dy <= 1; ++dy) {
            for (int dx = -1; dx <= 1; ++dx) {
                const int y = row + dy, x = column + dx;
                if ((dx || dy) && y >= 0 && y < rows && x >= 0 && x < columns) {
                    ++known;
                    others += (contact[y * columns + x] != 0) != (contact[p] != 0);
                }
            }
        }
        clean[p] = (contact[p] != 0) != (known > 1 && others >= known - 1);
    }
}

typedef struct { float x, y, z, variance; int known; } Side;

// The sum of normals on one side of a border: `deep` pixels from p on along `along`, as many as `wide` to either side.
Side gather(__global const float *vectors, __global const float *sigma, __global const uchar *clean, const int rows,
            const int columns, const int row, const int column, const int down, const int way, const int deep,
            const int wide)
{
    Side side = {0.0f, 0.0f, 0.0f, 0.0f, 0};
    for (int i = 0; i < deep; ++i) {
        for (int j = -wide; j <= wide; ++j) {
            const int y = row + (down ? way * i : j), x = column + (down ? j : way * i);
            if (y < 0 || y >= rows || x < 0 || x >= columns) continue;
            const int q = y * columns + x;
            if (!clean[q] || !(sigma[q] >= 0.0f)) continue;
            side.x += vectors[3L * q];
            side.y += vectors[3L * q + 1];
            side.z += vectors[3L * q + 2];
            side.variance += sigma[q] * sigma[q];
            ++side.known;
        }
    }
    return side;
}

// The angle between two sides if it is an edge, else 0. Cosines first: hardly any pixel needs the angle itself.
float jump_between(const Side a, const Side b, const float noise, const float least, const float sure)
{
    const float dot = a.x * b.x + a.y * b.y + a.z * b.z;
    const float lengths = sqrt((a.x * a.x + a.y * a.y + a.z * a.z) * (b.x * b.x + b.y * b.y + b.z * b.z));
    if (dot > SURELY_LESS * lengths) return 0.0f;
    const float x = a.y * b.z - a.z * b.y, y = a.z * b.x - a.x * b.z, z = a.x * b.y - a.y * b.x;
    const float angle = atan2(sqrt(x * x + y * y + z * z), dot);
    return angle > least && angle > sure * noise ? angle : 0.0f;
}

// Whether two normals are so sure that no mean of more is needed, and hardly differ.
int alike(__global const float *vectors, __global const float *sigma, const int p, const int q, const float quiet)
{
    const float dot = vectors[3L * p] * vectors[3L * q] + vectors[3L * p + 1] * vectors[3L * q + 1]
        + vectors[3L * p + 2] * vectors[3L * q + 2];
    return sigma[p] * sigma[p] + sigma[q] * sigma[q] <= quiet * quiet && dot > SURELY_LESS;
}

__kernel void edges_jumps(__global const float *restrict vectors, __global const float *restrict sigma,
                          __global const uchar *restrict clean, __global float *restrict jumps, const int rows,
                          const int columns, const float least, const float quiet, const float sure)
{
    EACH_PIXEL {
        const int row = p / columns, column = p % columns;
        for (int down = 0; down < 2; ++down) {
            float found = 0.0f;
            const int last = down ? row + 1 >= rows : column + 1 >= columns, next = p + (down ? columns : 1);
            // Quiet and alike, as nearly all are, or of no contact: that needs no window.
            const int plain = last || !clean[p] || !clean[next] || alike(vectors, sigma, p, next, quiet);
            for (int deep = 1; deep <= WIDEST && !plain; ++deep) {
                const int wide = deep - 1, enough = (deep * (2 * wide + 1) + 1) / 2;
                const Side a = gather(vectors, sigma, clean, rows, columns, row, column, down, -1, deep, wide);
                const Side b = gather(vectors, sigma, clean, rows, columns, row + down, column + 1 - down, down, 1,
                                      deep, wide);
                if (a.known < enough || b.known < enough) continue;
                const float noise = sqrt(a.variance / (a.known * a.known) + b.variance / (b.known * b.known));
                if (noise > quiet && deep < WIDEST) continue;
                found = jump_between(a, b, noise, least, sure);
                break;
            }
            jumps[(long)down * all + p] = found;
        }
    }
}

// A jump in a row or column of them; 0 beyond its ends.
float jump_at(__global const float *jumps, const int place, const int length, const int stride)
{
    return place >= 0 && place < length ? jumps[place * stride] : 0.0f;
}

// Whether the jump between a pixel and the next is the largest around, and which of the two is nearer to it: 0 neither.
int side_of(__global const float *jumps, const int place, const int length, const int stride)
{
    const float mine = jump_at(jumps, place, length, stride);
    if (!(mine > 0.0f)) return 0;
    for (int step = 1; step <= WIDEST; ++step) {
        if (jump_at(jumps, place + step, length, stride) > mine) return 0;
        if (jump_at(jumps, place - step, length, stride) >= mine) return 0;
    }
    return jump_at(jumps, place + 1, length, stride) > jump_at(jumps, place - 1, length, stride) ? 2 : 1;
}

// The jump of a line that crosses a row or column at a place; 0 without one.
float crossed(__global const float *jumps, const int place, const int length, const int stride)
{
    if (side_of(jumps, place, length, stride) == 1) return jump_at(jumps, place, length, stride);
    return side_of(jumps, place - 1, length, stride) == 2 ? jump_at(jumps, place - 1, length, stride) : 0.0f;
}

// The larger of the jumps on either side of a place.
float beside(__global const float *jumps, const int place, const int length, const int stride)
{
    const float before = jump_at(jumps, place - 1, length, stride), after = jump_at(jumps, place, length, stride);
    return before > after ? before : after;
}

__kernel void edges_thin(__global const float *restrict jumps, __global const uchar *restrict clean,
                         __global uchar *restrict edges, const int rows, const int columns)
{
    EACH_PIXEL {
        const int row = p / columns, column = p % columns;
        __global const float *right = jumps + row * columns, *below = jumps + all + column;
        // Of a slanting line, that way tells best on which it is crossed more steeply.
        const float across = crossed(right, column, columns, 1), down = crossed(below, row, rows, columns);
        int edge = (across > 0.0f && across >= beside(below, row, rows, columns))
            || (down > 0.0f && down >= beside(right, column, columns, 1));
        if (!clean[p]) {
            edge = (column > 0 && clean[p - 1]) || (column + 1 < columns && clean[p + 1])
                || (row > 0 && clean[p - columns]) || (row + 1 < rows && clean[p + columns]);
        }
        edges[p] = edge;
    }
}
