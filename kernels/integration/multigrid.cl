// Heights on a graph of pixels, by multigrid. Specification: multigrid.py.
//
// TILE       nodes of one work-item, a multiple of WIDTH, in passes over one level
// WIDTH      nodes in a vector: 8 on a CPU, 1 on a GPU
// ROWS       rows of a tile of nodes that a work-group processes in half a cycle; COLUMNS, its columns
// PART       nodes of one part of a sum
// LINKS      links of a node: 4, or 8 on coarse levels whose aggregates are not all blocks of two by two
// ANCHORED   1 if there are known heights, otherwise 0
// GROUP      work-items of the group that processes all small levels, 1 on a CPU
// STEPS      Jacobi steps in half a cycle on a level with launches of its own: 3 or 4
// NEAR_NODES nodes whose heights the group of the small levels keeps in local memory; 0 if in global memory
// ROUNDS     rounds in which parts of blocks move to another aggregate; even
// COARSEST   maximum number of nodes of the coarsest level, which is solved by the inverse of its matrix
// SUMS       work-items of a group that reduces one part, 1 if each item does so alone
// LANES      right-hand sides solved at once, 1, 4, 8 or 16: a node's value is a vector of them; WIDTH is then 1
//
// All levels are stored in the same arrays, one after the other. A level starts at `base` with a row of padding, then
// its rows of `stride` nodes, a multiple of 16, then another row of padding. So every node has neighbours in memory;
// the weight of a missing link is 0. A node's links lead to the right and down, and if there are 8 also along both
// diagonals downwards: `falling` to the right, `rising` to the left.

#include "common.clh"

#if LANES == 1
typedef float value;
#else
typedef JOIN(float, LANES) value;
#endif
#if WIDTH == 8
typedef float8 reals, values;  // of links, and of the values of nodes
typedef int8 ints;
typedef float8 __attribute__((aligned(4))) loose;  // unaligned
typedef float4 __attribute__((aligned(4))) half_loose;
#define AT(p) (*(__global const loose *)(p))
#define NEAR(p) (*(__local const loose *)(p))
#define PUT(p) *(__global loose *)(p)
#define PUT_NEAR(p) *(__local loose *)(p)
#define EVEN_OF(READ, p) ((float8)(READ(p).even, READ((p) + 8).even))
#define ODD_OF(READ, p) ((float8)(READ(p).odd, READ((p) + 8).odd))
#define PUT_BYTES(p, values) vstore8(convert_uchar8(values), 0, p)
#define WHOLE(v) (((v.s0 + v.s1) + (v.s2 + v.s3)) + ((v.s4 + v.s5) + (v.s6 + v.s7)))
#else
typedef float reals;
typedef value values;
typedef int ints;
#define AT(p) (*(p))
#define NEAR(p) (*(p))
#define PUT(p) *(p)
#define PUT_NEAR(p) *(p)
#define EVEN_OF(READ, p) ((p)[0])
#define ODD_OF(READ, p) ((p)[1])
#define PUT_BYTES(p, values) *(p) = values
#define WHOLE(v) (v)
#endif
#define EVEN(p) EVEN_OF(AT, p)
#if LANES > 1 && defined(__has_builtin)
#if __has_builtin(__builtin_nontemporal_store)
#define STREAM(p, value) __builtin_nontemporal_store(value, p)
#endif
#endif
#ifndef STREAM
#define STREAM(p, value) PUT(p) = value
#endif
#define ODD(p) ODD_OF(AT, p)

#define VALUES __global const value *restrict
#define OUT_VALUES __global value *restrict
#define BYTES __global const uchar *restrict
#define COUNTS __global const int *restrict
#define LEVEL_ARGS const int base, const int rows, const int stride
#define COARSE_ARGS const int coarse_base, const int coarse_rows, const int coarse_stride
#define GRAPH_ARGS MAP right, MAP down, MAP falling, MAP rising, MAP anchor
#define GRAPH right, down, falling, rising, anchor
#define INLINE static inline __attribute__((always_inline))
#define BETWEEN base, rows, stride, coarse_base, coarse_rows, coarse_stride

// The nodes of a level from `begin` to `end` that an item processes.
#define ITEMS_NODES                                                                                        \
    const int begin = base + stride + (int)get_global_id(0) * TILE;                                        \
    const int end = LESSER(begin + TILE, base + stride * (rows + 1));
#define EACH_NODE for (int i = begin; i < end; i += WIDTH)

#if ANCHORED
#define WITH_ANCHOR(value) + (value)
#else
#define WITH_ANCHOR(value)
#endif

// For nodes i: their links, the sum of the links and the anchor, the flow along the links, -A x, and the
// weighted sum of the neighbours. READ returns heights at p, in rows of s. The flow is computed from
// differences, for which float32 heights suffice.
#define AXES                                                                                               \
    const reals to_right = AT(right + i), to_left = AT(right + i - 1);                                     \
    const reals to_below = AT(down + i), to_above = AT(down + i - stride);
#if LINKS == 8
#define SIDES                                                                                              \
    AXES                                                                                                   \
    const reals to_fall = AT(falling + i), from_fall = AT(falling + i - stride - 1);                       \
    const reals to_rise = AT(rising + i), from_rise = AT(rising + i - stride + 1);
#define WITH_DIAGONALS(READ, p, s)                                                                         \
    + ((to_fall * (READ((p) + (s) + 1) - READ(p)) + from_fall * (READ((p) - (s) - 1) - READ(p)))           \
       + (to_rise * (READ((p) + (s) - 1) - READ(p)) + from_rise * (READ((p) - (s) + 1) - READ(p))))
#define WITH_CORNERS(READ, p, s)                                                                           \
    + ((to_fall * READ((p) + (s) + 1) + from_fall * READ((p) - (s) - 1))                                   \
       + (to_rise * READ((p) + (s) - 1) + from_rise * READ((p) - (s) + 1)))
#define WITH_DIAGONAL_SUMS + ((to_fall + from_fall) + (to_rise + from_rise))
#else
#define SIDES AXES
#define WITH_DIAGONALS(READ, p, s)
#define WITH_CORNERS(READ, p, s)
#define WITH_DIAGONAL_SUMS
#endif
#define SUM_OF_SIDES ((to_right + to_left) + (to_below + to_above) WITH_DIAGONAL_SUMS WITH_ANCHOR(AT(anchor + i)))
#define FLOW(READ, p, s)                                                                                   \
    ((to_right * (READ((p) + 1) - READ(p)) + to_left * (READ((p) - 1) - READ(p)))                          \
     + (to_below * (READ((p) + (s)) - READ(p)) + to_above * (READ((p) - (s)) - READ(p)))                   \
     WITH_DIAGONALS(READ, p, s) WITH_ANCHOR(-AT(anchor + i) * READ(p)))
#define AROUND_OF(READ, p, s)                                                                              \
    ((to_right * READ((p) + 1) + to_left * READ((p) - 1)) + (to_below * READ((p) + (s)) + to_above * READ((p) - (s))) \
     WITH_CORNERS(READ, p, s))
#define INVERSE(value) ((value) > 0 ? 1 / (value) : 0)

// Whether none of the nodes i has a link or an anchor, by their inverse diagonals, which are not negative. On a GPU
// and for several right sides, a test would cost more than it saves.
#if WIDTH == 8
INLINE int are_alone(__global const float *inverse)
{
    const int8 bits = as_int8(AT(inverse));
    const int4 four = bits.lo | bits.hi;
    const int2 two = four.lo | four.hi;
    return (two.x | two.y) == 0;
}
#define ALONE are_alone(inverse + i)
#else
#define ALONE 0
#endif

// --- Levels -----------------------------------------------------------------------------------------------------
//
// A coarse node represents an aggregate of fine ones, usually a block of two by two. If strong links do not connect all
// nodes of a block, as along a cut, the nodes outside its largest part join the aggregate of the neighbouring block to
// which their strongest link leads: `to` is 0 for a node that stays, otherwise 1 + 3 (down + 1) + (right + 1). Parts
// without a link to another block's largest part stay.

// Items process pieces of rows, in turn if one group does all.
#define PIECES ((stride / 2 + TILE - 1) / TILE)
#define EACH_PIECE for (int piece = get_global_id(0); piece < coarse_rows * PIECES; piece += (int)get_global_size(0))
#define OF_PIECE                                                                                           \
    const int row = piece / PIECES, from = piece % PIECES * TILE, upto = LESSER(stride / 2, from + TILE);  \
    const int first = base + stride * (2 * row + 1), coarse_first = coarse_base + coarse_stride * (row + 1);
#define EACH_BLOCK                                                                                         \
    for (int C = from, J = coarse_first + C, I = first + 2 * C, K = I + stride; C < upto;                  \
         C += WIDTH, J += WIDTH, I += 2 * WIDTH, K += 2 * WIDTH)
#define EACH_COARSE_NODE for (int C = from, J = coarse_first + from; C < upto; ++C, ++J)

// The weight of the link from node i to a node some rows down and columns to the right.
float link_of(const int i, const int stride, const int down_by, const int right_by, GRAPH_ARGS)
{
#if LINKS == 8
    if (down_by > 0 && right_by) return right_by > 0 ? falling[i] : rising[i];
    if (down_by < 0 && right_by) return right_by > 0 ? rising[i - stride + 1] : falling[i - stride - 1];
#endif
    return down_by ? right_by ? 0 : down[down_by > 0 ? i : i - stride] : right[right_by > 0 ? i : i - 1];
}

// A link is strong if it has a share of the geometric mean of its nodes' largest links along its axis.
#define STRONG(w, g, h) (((w) > 0) & ((w) * (w) >= strength * strength * (g) * (h)))
#define ALONG_X(PICK, i) GREATER(PICK(right + (i)), PICK(right + (i) - 1))
#define ALONG_Y(PICK, i) GREATER(PICK(down + (i)), PICK(down + (i) - stride))
#define BIT(condition, value) ((condition) ? (ints)(value) : (ints)0)
#define SIZE(part) (((part) & 1) + ((part) >> 1 & 1) + ((part) >> 2 & 1) + ((part) >> 3 & 1))
#define JOINED_TO(part)                                                                                    \
    (part | BIT((part & 1) != 0, join_a) | BIT((part & 2) != 0, join_b) | BIT((part & 4) != 0, join_c)     \
     | BIT((part & 8) != 0, join_d))
#define LARGER(part) main = SIZE(part) > SIZE(main) ? part : main;

// For each block with nodes a, b and below them c, d, by bits: the largest part, and, shifted by 4 bits, the
// nodes with links.
#define PARTS_ARGS                                                                                         \
    LEVEL_ARGS, COARSE_ARGS, const float strength, GRAPH_ARGS, __global uchar *restrict parts,             \
    __global int *restrict touched, const int level, __global int *restrict splits
INLINE void find_parts(PARTS_ARGS)
{
    EACH_PIECE {
        OF_PIECE
        EACH_BLOCK {
            const reals ax = ALONG_X(EVEN, I), bx = ALONG_X(ODD, I), cx = ALONG_X(EVEN, K), dx = ALONG_X(ODD, K);
            const reals ay = ALONG_Y(EVEN, I), by = ALONG_Y(ODD, I), cy = ALONG_Y(EVEN, K), dy = ALONG_Y(ODD, K);
            const reals ab = EVEN(right + I), cd = EVEN(right + K), ac = EVEN(down + I), bd = ODD(down + I);
            const ints is_ab = BIT(STRONG(ab, ax, bx), 15), is_cd = BIT(STRONG(cd, cx, dx), 15);
            const ints is_ac = BIT(STRONG(ac, ay, cy), 15), is_bd = BIT(STRONG(bd, by, dy), 15);
#if LINKS == 8
            const reals ad = EVEN(falling + I), bc = ODD(rising + I);
            const ints is_ad = BIT(STRONG(ad, GREATER(ax, ay), GREATER(dx, dy)), 15);
            const ints is_bc = BIT(STRONG(bc, GREATER(bx, by), GREATER(cx, cy)), 15);
#else
            const ints is_ad = 0, is_bc = 0;
#endif
            const ints join_a = 1 | (is_ab & 2) | (is_ac & 4) | (is_ad & 8);
            const ints join_b = 2 | (is_ab & 1) | (is_bc & 4) | (is_bd & 8);
            const ints join_c = 4 | (is_ac & 1) | (is_bc & 2) | (is_cd & 8);
            const ints join_d = 8 | (is_ad & 1) | (is_bd & 2) | (is_cd & 4);
            const ints live = BIT(GREATER(ax, ay) > 0, 1) | BIT(GREATER(bx, by) > 0, 2) | BIT(GREATER(cx, cy) > 0, 4)
                | BIT(GREATER(dx, dy) > 0, 8);
            const ints a = JOINED_TO(join_a), b = JOINED_TO(join_b), c = JOINED_TO(join_c), d = JOINED_TO(join_d);
            ints main = JOINED_TO(a) & live;
            const ints with_b = JOINED_TO(b) & live, with_c = JOINED_TO(c) & live, with_d = JOINED_TO(d) & live;
            LARGER(with_b)
            LARGER(with_c)
            LARGER(with_d)
            PUT_BYTES(parts + J, main | live << 4);
        }
        int some = 0;
        EACH_COARSE_NODE {
            touched[J] = 0;
            some |= (parts[J] >> 4) & ~parts[J];
        }
        if (some) atomic_or(splits + level, 1);
    }
}
__kernel void multigrid_parts(PARTS_ARGS) { find_parts(BETWEEN, strength, GRAPH, parts, touched, level, splits); }

// Rows and columns from a node's block to its aggregate.
#define WENT_DOWN(i) (to[i] ? (to[i] - 1) / 3 - 1 : 0)
#define WENT_RIGHT(i) (to[i] ? (to[i] - 1) % 3 - 1 : 0)

// Number of a node in the block that starts at I, from 0 to 3.
#define NODE(k) (I + (k) / 2 * stride + (k) % 2)

// Assigns parts that are not the largest of their block to aggregates. In each round, an unassigned part
// moves to the adjacent aggregate with the strongest links to assigned nodes, unless another of its links
// would then lead further than to the next aggregate. In the last round, parts for which this has become true
// stay with their block, and aggregates that are not blocks are marked.
#define MOVE_ARGS                                                                                          \
    LEVEL_ARGS, COARSE_ARGS, const float strength, GRAPH_ARGS, BYTES parts, const int clear,               \
    const int first_round, const int last_round, BYTES to, __global uchar *restrict places,                \
    __global int *restrict touched, const int level, COUNTS splits, __global int *restrict moves
INLINE void move_parts(MOVE_ARGS)
{
    if (splits[level] == 0) return;
    EACH_PIECE {
        OF_PIECE
        for (int x = 2 * from; x < 2 * upto && clear; ++x) places[first + x] = places[first + stride + x] = 0;
        EACH_COARSE_NODE {
            const int I = first + 2 * C;
            for (int rest = (parts[J] >> 4) & ~parts[J]; rest;) {
                int part = rest & -rest, before = 0;
                while (part != before) {  // everything connected to it
                    before = part;
                    for (int k = 0; k < 16; ++k) {
                        const int a = NODE(k / 4), b = NODE(k % 4), y = k % 4 / 2 - k / 8, x = k % 2 - k / 4 % 2;
                        if (!(part >> k / 4 & 1) || !(rest >> k % 4 & 1) || k / 4 == k % 4) continue;
                        const float w = link_of(a, stride, y, x, right, down, falling, rising, anchor);
                        const float ax = ALONG_X(*, a), ay = ALONG_Y(*, a), bx = ALONG_X(*, b), by = ALONG_Y(*, b);
                        const float g = y == 0 ? ax : x == 0 ? ay : GREATER(ax, ay);
                        const float h = y == 0 ? bx : x == 0 ? by : GREATER(bx, by);
                        if (STRONG(w, g, h)) part |= 1 << k % 4;
                    }
                }
                rest &= ~part;
                float sums[9] = {0, 0, 0, 0, 0, 0, 0, 0, 0}, largest = 0;
                // the range in which no link would be too long
                int top = -2, bottom = 2, left = -2, right_most = 2, old = 0, target = 0;
                for (int k = 0; k < 36; ++k) {
                    const int m = k / 9, y = k % 9 / 3 - 1, x = k % 3 - 1, v = m / 2 + y, u = m % 2 + x;
                    const int inside = v >> 1 == 0 && u >> 1 == 0;
                    if (!(part >> m & 1) || (inside && part >> (2 * v + u) & 1)) continue;
                    if (!first_round) old = to[NODE(m)];
                    const float w = link_of(NODE(m), stride, y, x, right, down, falling, rising, anchor);
                    if (w == 0) continue;
                    const int j = NODE(m) + y * stride + x, J_there = J + (v >> 1) * coarse_stride + (u >> 1);
                    const int went = first_round ? 0 : to[j];
                    const int below = (v >> 1) + (went ? (went - 1) / 3 - 1 : 0), across = (u >> 1) + (went ? (went - 1) % 3 - 1 : 0);
                    top = GREATER(top, below - 1);
                    bottom = LESSER(bottom, below + 1);
                    left = GREATER(left, across - 1);
                    right_most = LESSER(right_most, across + 1);
                    const int has_place = went || parts[J_there] >> (2 * (v & 1) + (u & 1)) & 1;
                    if (!has_place || inside || below < -1 || below > 1 || across < -1 || across > 1) continue;
                    // in registers
                    for (int way = 0; way < 9; ++way) sums[way] += way == 3 * below + across + 4 ? w : 0;
                }
                for (int way = 0; way < 9; ++way) {
                    const int y = way / 3 - 1, x = way % 3 - 1, is_old = way + 1 == old;
                    if (sums[way] == 0 || y < top || y > bottom || x < left || x > right_most) continue;
                    if (last_round ? is_old : is_old || sums[way] > largest) {
                        largest = is_old ? INFINITY : sums[way];
                        target = way + 1;
                    }
                }
                if (last_round && target == 5) target = 0;
                for (int k = 0; k < 4; ++k) {
                    if (part >> k & 1) places[NODE(k)] = target;
                }
                if (!last_round || !target) continue;
                atomic_or(touched + J, 1);
                atomic_or(touched + J + ((target - 1) / 3 - 1) * coarse_stride + (target - 1) % 3 - 1, 1);
                atomic_inc(moves + level);
            }
        }
    }
}
__kernel void multigrid_move(MOVE_ARGS)
{
    move_parts(BETWEEN, strength, GRAPH, parts, clear, first_round, last_round, to, places, touched, level, splits, moves);
}

// Fine nodes i of the aggregate J, whose block is at row R and column C of the coarse level, from all blocks
// around it.
#define BELONGS(i, y, x)                                                                                   \
    (to[i] ? ((y) >> 1) + WENT_DOWN(i) == row && ((x) >> 1) + WENT_RIGHT(i) == C : (y) >> 1 == row && (x) >> 1 == C)
#define EACH_MEMBER                                                                                        \
    for (int y = 2 * GREATER(row - 1, 0); y < 2 * LESSER(row + 2, coarse_rows); ++y)                       \
        for (int x = GREATER(2 * C - 2, 0), i = base + stride * (y + 1) + x; x < LESSER(2 * C + 4, stride); ++x, ++i) \
            if (BELONGS(i, y, x))
#define IS_TOUCHED(J)                                                                                      \
    (touched[J - coarse_stride - 1] | touched[J - coarse_stride] | touched[J - coarse_stride + 1] | touched[J - 1] \
     | touched[J] | touched[J + 1] | touched[J + coarse_stride - 1] | touched[J + coarse_stride]           \
     | touched[J + coarse_stride + 1])

// The coarse links and anchors, and a list of the aggregates that are not blocks. A coarse link has half the
// summed weight of its fine links, because the centres of aggregates are twice as far apart; links further
// than to the next aggregate are dropped.
#define COARSEN_ARGS                                                                                       \
    LEVEL_ARGS, COARSE_ARGS, GRAPH_ARGS, BYTES to, COUNTS touched, const int level, COUNTS moves,          \
    OUT coarse_right, OUT coarse_down, OUT coarse_falling, OUT coarse_rising, OUT coarse_anchor,           \
    __global int *restrict changed, __global int *restrict changes
INLINE void coarsen(COARSEN_ARGS)
{
    EACH_PIECE {
        OF_PIECE
        EACH_BLOCK {
#if LINKS == 8
            PUT(coarse_right + J) = 0.5f * ((ODD(right + I) + ODD(right + K)) + (ODD(falling + I) + EVEN(rising + I + 2)));
            PUT(coarse_down + J) = 0.5f * ((EVEN(down + K) + ODD(down + K)) + (EVEN(falling + K) + ODD(rising + K)));
            PUT(coarse_falling + J) = 0.5f * ODD(falling + K);
            PUT(coarse_rising + J) = 0.5f * EVEN(rising + K);
#else
            PUT(coarse_right + J) = 0.5f * (ODD(right + I) + ODD(right + K));
            PUT(coarse_down + J) = 0.5f * (EVEN(down + K) + ODD(down + K));
            PUT(coarse_falling + J) = 0;
            PUT(coarse_rising + J) = 0;
#endif
#if ANCHORED
            PUT(coarse_anchor + J) = (EVEN(anchor + I) + ODD(anchor + I)) + (EVEN(anchor + K) + ODD(anchor + K));
#endif
        }
        if (moves[level] == 0) continue;
        EACH_COARSE_NODE {
            if (touched[J]) changed[coarse_base + atomic_inc(changes + level)] = J;
            if (!IS_TOUCHED(J)) continue;
            float to_right = 0, to_below = 0, falls = 0, rises = 0, held = 0;
            EACH_MEMBER {
#if ANCHORED
                held += anchor[i];
#endif
                for (int way = 0; way < 9; ++way) {
                    const float w = way == 4 ? 0
                        : link_of(i, stride, way / 3 - 1, way % 3 - 1, right, down, falling, rising, anchor);
                    if (w == 0) continue;
                    const int v = y + way / 3 - 1, u = x + way % 3 - 1, j = i + (way / 3 - 1) * stride + way % 3 - 1;
                    const int below = (v >> 1) + WENT_DOWN(j) - row, across = (u >> 1) + WENT_RIGHT(j) - C;
                    if (below == 0 && across == 1) to_right += w;
                    if (below == 1 && across == -1) rises += w;
                    if (below == 1 && across == 0) to_below += w;
                    if (below == 1 && across == 1) falls += w;
                }
            }
            coarse_right[J] = 0.5f * to_right;
            coarse_rising[J] = 0.5f * rises;
            coarse_down[J] = 0.5f * to_below;
            coarse_falling[J] = 0.5f * falls;
#if ANCHORED
            coarse_anchor[J] = held;
#endif
        }
    }
}
#define COARSE_GRAPH coarse_right, coarse_down, coarse_falling, coarse_rising, coarse_anchor
__kernel void multigrid_coarsen(COARSEN_ARGS)
{
    coarsen(BETWEEN, GRAPH, to, touched, level, moves, COARSE_GRAPH, changed, changes);
}

// A kernel called by another kernel is not portable, so the common code is in functions. All levels from
// `from` on, by one group, and the inverse of their diagonals; for blocks only if `plain` is 1.
typedef struct {
    int base, rows, stride;
} Level;

#define EACH_OF_LEVEL                                                                                      \
    for (int i = base + stride + (int)get_local_id(0) * WIDTH; i < base + stride * (rows + 1);             \
         i += (int)get_local_size(0) * WIDTH)
#define OF_LEVEL(l) const int base = levels[l].base, rows = levels[l].rows, stride = levels[l].stride;
#define OF_COARSE(l) const int coarse_base = levels[l].base, coarse_rows = levels[l].rows, coarse_stride = levels[l].stride;
#define FENCE barrier(CLK_GLOBAL_MEM_FENCE | CLK_LOCAL_MEM_FENCE);

// The inverse of the coarsest level's matrix, by one group. Elimination only adds, multiplies and divides
// positive numbers (Grassmann, Taksar and Heyman, Operations Research 33, 1985): the sum of a node's links
// and anchor is its pivot. The last node of a component without anchors has pivot 0, and is held at 0. With u
// the links of node k over its pivot d, row k of the inverse M is u M, and 1 / d + u M u on the diagonal.
#define EACH_LATER(j, k) for (int j = (k) + 1 + (int)get_local_id(0); j < nodes; j += (int)get_local_size(0))
#define NEAR_BARRIER barrier(CLK_LOCAL_MEM_FENCE);
INLINE void invert_coarsest(
    LEVEL_ARGS, GRAPH_ARGS, OUT matrix, __local float *m, __local float *held, __local float *pivots)
{
    const int nodes = rows * stride, first = base + stride;
    EACH_LATER(n, -1) {
        for (int k = 0; k < nodes; ++k) {
            const int y = k / stride - n / stride, x = k % stride - n % stride;
            const int adjacent = (y || x) && y * y <= 1 && x * x <= 1;
            m[n * nodes + k] = adjacent ? link_of(first + n, stride, y, x, right, down, falling, rising, anchor) : 0;
        }
        held[n] = 0 WITH_ANCHOR(anchor[first + n]);
    }
    NEAR_BARRIER
    for (int k = 0; k < nodes; ++k) {
        float pivot = held[k];
        for (int j = k + 1; j < nodes; ++j) pivot += m[k * nodes + j];
        const float inverse = INVERSE(pivot);
        for (int n = get_local_id(0); n < (nodes - k - 1) * (nodes - k - 1) && inverse > 0; n += get_local_size(0)) {
            const int i = k + 1 + n / (nodes - k - 1), j = k + 1 + n % (nodes - k - 1);
            if (i != j) m[i * nodes + j] += m[k * nodes + i] * inverse * m[k * nodes + j];
        }
        NEAR_BARRIER
        EACH_LATER(j, k) {
            m[k * nodes + j] *= inverse;
            held[j] += m[k * nodes + j] * held[k];
        }
        if (get_local_id(0) == 0) pivots[k] = inverse;
        NEAR_BARRIER
    }
    for (int k = nodes - 1; k >= 0; --k) {
        EACH_LATER(j, k) {
            float sum = 0;
            for (int i = k + 1; i < nodes; ++i) sum += m[k * nodes + i] * m[i * nodes + j];
            m[j * nodes + k] = sum;
        }
        NEAR_BARRIER
        if (get_local_id(0) == 0) {
            float sum = pivots[k];
            for (int i = k + 1; i < nodes; ++i) sum += m[k * nodes + i] * m[i * nodes + k];
            m[k * nodes + k] = sum;
        }
        NEAR_BARRIER
        EACH_LATER(j, k) m[k * nodes + j] = m[j * nodes + k];
        NEAR_BARRIER
    }
    EACH_LATER(n, -1) for (int k = 0; k < nodes; ++k) matrix[k * nodes + n] = m[k * nodes + n];
}
__kernel GROUP_SIZE void multigrid_build(
    const int from, const int last, __global const Level *restrict levels, const int plain, const float strength,
    __global float *right, __global float *down, __global float *falling, __global float *rising, __global float *anchor,
    OUT inverse, __global uchar *parts, __global uchar *proposed, __global uchar *to, __global int *touched,
    __global int *splits,
    __global int *moves, __global int *changed, __global int *changes, OUT matrix)
{
    __local float m[COARSEST * COARSEST], held[COARSEST], pivots[COARSEST];
    for (int l = from; l <= last; ++l) {
        OF_LEVEL(l)
        EACH_OF_LEVEL {
            SIDES
            const reals diagonal = SUM_OF_SIDES;
            PUT(inverse + i) = INVERSE(diagonal);
        }
        if (l == last) break;
        OF_COARSE(l + 1)
        if (!plain) {
            find_parts(BETWEEN, strength, GRAPH, parts, touched, l, splits);
            FENCE
            for (int turn = 0; turn < ROUNDS; ++turn) {
                __global uchar *old = turn % 2 ? proposed : to, *new = turn % 2 ? to : proposed;
                const int first = turn == 0, last_round = turn == ROUNDS - 1;
                move_parts(BETWEEN, strength, GRAPH, parts, turn < 2, first, last_round, old, new, touched, l, splits, moves);
                FENCE
            }
        }
        coarsen(BETWEEN, GRAPH, to, touched, l, moves, GRAPH, changed, changes);
        FENCE
    }
    OF_LEVEL(last)
    invert_coarsest(base, rows, stride, GRAPH, matrix, m, held, pivots);
}

// --- Cycles -----------------------------------------------------------------------------------------------------

// Jacobi steps: a Chebyshev polynomial for the upper half of the spectrum, and one step for the remainder of
// the block sums.
#define FIRST 1.3896f
#define SECOND 0.5617f
#define THIRD 1.0f
#if STEPS == 4  // if launches cost more than arithmetic: for levels visited once, found by experiment
#define LARGE_FIRST 3.2f
#define LARGE_EXTRA 0.53f
#define LARGE_SECOND 1.0f
#define LARGE_THIRD 0.9f
#else
#define LARGE_FIRST FIRST
#define LARGE_SECOND SECOND
#define LARGE_THIRD THIRD
#endif
#define STEP_BY(omega, READ, p, s) ((1 - (omega)) * READ(p) + (omega) * AT(inverse + i) * (AT(b + i) + AROUND_OF(READ, p, s)))

// The values of the aggregates of nodes, for fine nodes i with blocks at J; from e in some memory.
#if WIDTH == 8
#define SPREAD(SPACE, J) ((*(SPACE const half_loose *)(e + (J))).s00112233)
#else
#define SPREAD(SPACE, J) e[J]
#endif
#define INJECTED(NAME, SPACE)                                                                              \
    values NAME(const int i, const int J, const int coarse_stride, SPACE const value *e, const int moved, BYTES to) \
    {                                                                                                      \
        values interpolated = SPREAD(SPACE, J);                                                            \
        if (!moved || (WIDTH == 8 && *(__global const ulong *)(to + i) == 0)) return interpolated;         \
        for (int k = 0; k < WIDTH; ++k)                                                                    \
            if (to[i + k])                                                                                 \
                ((value *)&interpolated)[k] = e[J + k / 2 + WENT_DOWN(i + k) * coarse_stride + WENT_RIGHT(i + k)]; \
        return interpolated;                                                                               \
    }
INJECTED(injected, __global)

// The sum of the values of the members of an aggregate.
#define GATHERED(NAME, SPACE)                                                                              \
    value NAME(const int J, const int base, const int stride, COARSE_ARGS, BYTES to, SPACE const value *had, \
        const int origin)                                                                                  \
    {                                                                                                      \
        const int row = (J - coarse_base) / coarse_stride - 1, C = (J - coarse_base) % coarse_stride;      \
        value sum = 0;                                                                                     \
        EACH_MEMBER sum += had[i - origin];                                                                       \
        return sum;                                                                                        \
    }
GATHERED(gathered, __global)

// A tile of a level with a margin of SIDE nodes, in local memory. Beyond the rows there is nothing; beyond
// the columns are nodes of other rows, to which no link leads.
#define AROUND STEPS
#define SIDE (WIDTH == 8 ? 8 : AROUND)
#define ACROSS (COLUMNS + 2 * SIDE)
#define TILE_ITEMS                                                                                         \
    __local value one_room[(ROWS + 2 * AROUND) * ACROSS + 2 * SIDE], other_room[(ROWS + 2 * AROUND) * ACROSS + 2 * SIDE]; \
    __local value *one = one_room + SIDE, *other = other_room + SIDE;                                      \
    const int lanes = LESSER((int)get_local_size(0), COLUMNS / WIDTH), lane = get_local_id(0) % lanes;     \
    const int lines = get_local_size(0) / lanes;                                                           \
    const int line = (int)get_local_id(0) < lanes * lines ? (int)get_local_id(0) / lanes : ROWS + AROUND;  \
    const int across = (stride + COLUMNS - 1) / COLUMNS, top = get_group_id(0) / across * ROWS;            \
    const int first_column = get_group_id(0) % across * COLUMNS, wide = LESSER(COLUMNS, stride - first_column); \
    const int is_live = live[first_tile + get_group_id(0)];
#define EACH_LINE(more) for (int y = line - (more); y < ROWS + (more) && is_live; y += lines)
#define EACH_OF_LINE(more)                                                                                 \
    for (int x = lane * WIDTH - ((more) ? SIDE : 0), i = base + stride * (top + y + 1) + first_column + x, \
             p = (y + AROUND) * ACROSS + SIDE + x;                                                         \
         x < wide + ((more) ? SIDE : 0); x += lanes * WIDTH, i += lanes * WIDTH, p += lanes * WIDTH)
// Applied to the nodes of a tile with a margin of `more`; memory outside the level's rows is set to 0.
#define FILL(more, scratch)                                                                                \
    EACH_LINE(more) if (top + y < 0 || top + y >= rows) EACH_OF_LINE(more) PUT_NEAR(scratch + p) = 0;      \
    EACH_LINE(more) if (top + y >= 0 && top + y < rows) EACH_OF_LINE(more)
#define FILLED barrier(CLK_LOCAL_MEM_FENCE);
#define STEP_NEAR(omega, from, to)                                                                         \
    if (ALONE) {                                                                                           \
        PUT_NEAR(to + p) = (1 - (omega)) * NEAR(from + p);                                                 \
    } else {                                                                                               \
        SIDES                                                                                              \
        PUT_NEAR(to + p) = STEP_BY(omega, NEAR, from + p, ACROSS);                                         \
    }
#define EACH_COARSE_OF_TILE                                                                                \
    for (int y = line, coarse_of_tile = coarse_base + coarse_stride * (top / 2 + 1) + first_column / 2;    \
         y < ROWS / 2 && top / 2 + y < coarse_rows; y += lines)                                            \
        for (int x = lane * WIDTH; x < wide / 2; x += lanes * WIDTH)
#if STEPS == 4
#define STARTED other
#define EXTRA_STEP FILL(3, one) { STEP_NEAR(LARGE_EXTRA, other, one) } FILLED
#else
#define STARTED one
#define EXTRA_STEP
#endif
#define MINE (y >= 0 && y < ROWS && x >= 0 && x < wide)

// The inverse of the diagonal, and the tiles, one per group, that have nodes with links or anchors: all
// others are skipped.
__kernel void multigrid_invert(LEVEL_ARGS, GRAPH_ARGS, OUT inverse, const int first_tile, __global uchar *restrict live)
{
    const int across = (stride + COLUMNS - 1) / COLUMNS, tile = get_group_id(0), top = tile / across * ROWS;
    const int bottom = LESSER(top + ROWS, rows);
    const int first_column = tile % across * COLUMNS, right_end = LESSER(first_column + COLUMNS, stride);
    __local int any;
    if (get_local_id(0) == 0) any = 0;
    barrier(CLK_LOCAL_MEM_FENCE);
    reals sum = 0;
    for (int y = top; y < bottom; ++y) {
        for (int x = first_column + (int)get_local_id(0) * WIDTH; x < right_end; x += (int)get_local_size(0) * WIDTH) {
            const int i = base + stride * (y + 1) + x;
            SIDES
            const reals diagonal = SUM_OF_SIDES;
            PUT(inverse + i) = INVERSE(diagonal);
            sum += diagonal;
        }
    }
    if (WHOLE(sum) > 0) atomic_or(&any, 1);
    barrier(CLK_LOCAL_MEM_FENCE);
    if (get_local_id(0) == 0) live[first_tile + tile] = any;
}

// Jacobi steps, from heights x or from zero, to t; and the sums of the residual over blocks, which are the
// coarse right-hand side. The residual itself is stored if `keep` is 1.
__kernel void multigrid_descend(
    LEVEL_ARGS, COARSE_ARGS, GRAPH_ARGS, MAP inverse, BYTES live, const int first_tile, VALUES b, const int again, VALUES x_before, OUT_VALUES t, const int keep,
    OUT_VALUES residual, OUT_VALUES coarse_b)
{
    TILE_ITEMS
    if (again) {
        FILL(STEPS, STARTED) { SIDES PUT_NEAR(STARTED + p) = STEP_BY(LARGE_FIRST, AT, x_before + i, stride); }
    } else {
        FILL(STEPS, STARTED) PUT_NEAR(STARTED + p) = LARGE_FIRST * AT(inverse + i) * AT(b + i);
    }
    FILLED
    EXTRA_STEP
    FILL(2, other) { STEP_NEAR(LARGE_SECOND, one, other) }
    FILLED
    FILL(1, one) {
        STEP_NEAR(LARGE_THIRD, other, one)
        if (MINE) STREAM(t + i, NEAR(one + p));
    }
    FILLED
    FILL(0, other) {
        values rest = AT(b + i);
        if (!ALONE) {
            SIDES
            rest += FLOW(NEAR, one + p, ACROSS);
        }
        PUT_NEAR(other + p) = rest;
        if (keep) PUT(residual + i) = rest;
    }
    FILLED
    EACH_COARSE_OF_TILE {
        __local const value *upper = other + (2 * y + AROUND) * ACROSS + SIDE + 2 * x, *lower = upper + ACROSS;
        const values sum = (EVEN_OF(NEAR, upper) + ODD_OF(NEAR, upper)) + (EVEN_OF(NEAR, lower) + ODD_OF(NEAR, lower));
        PUT(coarse_b + coarse_of_tile + coarse_stride * y + x) = is_live ? sum : (values)0;
    }
}

// The coarse right-hand side of aggregates that are not blocks.
#define SOME GREATER(TILE / 16, 1)
__kernel void multigrid_gather(LEVEL_ARGS, COARSE_ARGS, BYTES to, COUNTS changed, const int count, VALUES residual, OUT_VALUES coarse_b)
{
    const int begin = get_global_id(0) * SOME, end = LESSER(begin + SOME, count);
    for (int n = begin; n < end; ++n) {
        const int J = changed[coarse_base + n];
        coarse_b[J] = gathered(J, base, stride, coarse_base, coarse_rows, coarse_stride, to, residual, 0);
    }
}

// The values of the aggregates, added to t, and Jacobi steps; the sums over tiles of the heights times the
// right-hand side.
__kernel void multigrid_ascend(
    LEVEL_ARGS, COARSE_ARGS, GRAPH_ARGS, MAP inverse, BYTES live, const int first_tile, VALUES b, VALUES e, const int moved_nodes, BYTES to, VALUES t,
    OUT_VALUES x_new, OUT_VALUES parts)
{
    TILE_ITEMS
    FILL(STEPS, STARTED) {
        const int J = coarse_base + coarse_stride * (((top + y) >> 1) + 1) + ((first_column + x) >> 1);
        PUT_NEAR(STARTED + p) = AT(t + i) + injected(i, J, coarse_stride, e, moved_nodes, to);
    }
    FILLED
    EXTRA_STEP
    FILL(2, other) { STEP_NEAR(LARGE_THIRD, one, other) }
    FILLED
    FILL(1, one) { STEP_NEAR(LARGE_SECOND, other, one) }
    FILLED
    values sum = 0;
    FILL(0, other) {
        values height = (1 - LARGE_FIRST) * NEAR(one + p);
        if (!ALONE) {
            SIDES
            height = STEP_BY(LARGE_FIRST, NEAR, one + p, ACROSS);
        }
        STREAM(x_new + i, height);
        sum += height * AT(b + i);
    }
    FILLED
    for (int y = line; y < ROWS && top + y < rows && !is_live; y += lines) {
        EACH_OF_LINE(0) PUT(x_new + i) = 0;
    }
    other[get_local_id(0)] = WHOLE(sum);
    barrier(CLK_LOCAL_MEM_FENCE);
    if (get_local_id(0) == 0) {
        value total = 0;
        for (int k = 0; k < (int)get_local_size(0); ++k) total += other[k];
        parts[get_group_id(0)] = total;
    }
}

// A cycle over all levels from `from` on that are too small for launches of their own, by one group: the
// solution for b, after `multigrid_gather`, is stored in x. Coarser levels are visited twice, and the first
// one if `twice` is 1. The inverse of the last level's matrix is given.
#if NEAR_NODES > 0  // WIDTH is 1, and pointers to local memory are read like others
INJECTED(injected_near, __local)
GATHERED(gathered_near, __local)
#define INJECTED_AT injected_near
#define GATHERED_AT gathered_near
#define ROOMS                                                                                              \
    __local value x_room[NEAR_NODES], t_room[NEAR_NODES];                                                  \
    const int origin = levels[from].base - 1;                                                              \
    for (int i = get_local_id(0); i < NEAR_NODES; i += (int)get_local_size(0)) x_room[i] = t_room[i] = 0;  \
    FENCE
#else
#define INJECTED_AT injected
#define GATHERED_AT gathered
#define ROOMS                                                                                              \
    __global value *x_room = x, *t_room = t;                                                               \
    const int origin = 0;
#endif
#define X(i) (x_room + (i) - origin)
#define T(i) (t_room + (i) - origin)
#define SMOOTH(omega, FROM, TO)                                                                            \
    EACH_OF_LEVEL {                                                                                        \
        SIDES                                                                                              \
        PUT(TO(i)) = STEP_BY(omega, AT, FROM(i), stride);                                        \
    }                                                                                                      \
    FENCE
__kernel GROUP_SIZE void multigrid_tail(
    const int from, const int last, __global const Level *restrict levels, GRAPH_ARGS, MAP inverse, MAP matrix,
    BYTES to, COUNTS changed, COUNTS changes, const int twice, VALUES residual, __global value *b,
    __global value *x, __global value *t)
{
    ROOMS
    if (from > 0) {
        OF_LEVEL(from - 1)
        OF_COARSE(from)
        for (int n = get_local_id(0); n < changes[from - 1]; n += (int)get_local_size(0)) {
            const int J = changed[coarse_base + n];
            b[J] = gathered(J, base, stride, coarse_base, coarse_rows, coarse_stride, to, residual, 0);
        }
    }
    FENCE
    int l = from, start = 0, gone = 0;  // a bit for each level
    do {
        for (; l < last; ++l, start = 0) {
            OF_LEVEL(l)
            OF_COARSE(l + 1)
            const int moved = changes[l];
            if (start) {
                SMOOTH(FIRST, X, T)
            } else {
                EACH_OF_LEVEL PUT(T(i)) = FIRST * AT(inverse + i) * AT(b + i);
                FENCE
            }
            SMOOTH(SECOND, T, X)
            SMOOTH(THIRD, X, T)
            EACH_OF_LEVEL {
                SIDES
                PUT(X(i)) = AT(b + i) + FLOW(AT, T(i), stride);
            }
            FENCE
            const int across = stride / 2;
            for (int n = get_local_id(0) * WIDTH; n < coarse_rows * across; n += (int)get_local_size(0) * WIDTH) {
                const int row = n / across, C = n % across, I = base + stride * (2 * row + 1) + 2 * C, K = I + stride;
                PUT(b + coarse_base + coarse_stride * (row + 1) + C) = (EVEN(X(I)) + ODD(X(I))) + (EVEN(X(K)) + ODD(X(K)));
            }
            FENCE
            for (int n = get_local_id(0); n < moved; n += (int)get_local_size(0)) {
                const int J = changed[coarse_base + n];
                b[J] = GATHERED_AT(J, base, stride, coarse_base, coarse_rows, coarse_stride, to, x_room, origin);
            }
            FENCE
        }
        {
            OF_LEVEL(last)
            EACH_OF_LEVEL {
                values sum = 0;
                for (int k = 0, nodes = rows * stride, first = base + stride; k < nodes; ++k)
                    sum += AT(matrix + k * nodes + i - first) * b[first + k];
                PUT(X(i)) = sum;
            }
            FENCE
        }
        while (l > from && !start) {
            --l;
            OF_LEVEL(l)
            OF_COARSE(l + 1)
            EACH_OF_LEVEL {
                const int n = i - base - stride, J = coarse_base + coarse_stride * (n / stride / 2 + 1) + n % stride / 2;
                PUT(T(i)) = AT(T(i)) + INJECTED_AT(i, J - origin, coarse_stride, x_room, changes[l], to);
            }
            FENCE
            SMOOTH(THIRD, T, X)
            SMOOTH(SECOND, X, T)
            SMOOTH(FIRST, T, X)
            start = (l > from || twice) && !(gone >> l & 1);
            gone = start ? gone | 1 << l : gone & ~(1 << l);
        }
    } while (start);
#if NEAR_NODES > 0
    OF_LEVEL(from)
    EACH_OF_LEVEL x[i] = *X(i);
#endif
}

// --- Conjugate gradients ----------------------------------------------------------------------------------------
//
// Sums are stored in parts, which each group of the next kernel adds up: no sum is copied to the host. For each cycle and each
// right-hand side, `history` contains the product of b and z, the length of the step, and the square of b before it. A length is
// 0 if one of the two products is not positive, or `moving` is 0.

#define HISTORY(cycle, number) history[3 * (cycle) + (number)]
#define RATIO(a, b) ((((a) > 0) & ((b) > 0)) ? (a) / (b) : (value)0)
#define ALONG(length, what) ((length) != 0 ? (length) * (what) : (values)0)
#if LANES == 1
#define EACH_LIVE EACH_OF_PART
#else
#define EACH_LIVE EACH_OF_PART if (inverse[i] > 0)
#endif

// The residual, b - A x.
__kernel void multigrid_residual(LEVEL_ARGS, GRAPH_ARGS, MAP inverse, VALUES b, VALUES x, OUT_VALUES residual)
{
    ITEMS_NODES
    EACH_NODE {
        if (ALONE) {
            PUT(residual + i) = AT(b + i);
            continue;
        }
        SIDES
        PUT(residual + i) = AT(b + i) + FLOW(AT, x + i, stride);
    }
}

// A sum over PART nodes: by one item, or by a group, each of whose items processes one of SUMS nodes.
#if SUMS > 1
#define SUM_GROUP __attribute__((reqd_work_group_size(SUMS, 1, 1)))
#define PART_NODES                                                                                         \
    __local value scratch[SUMS];                                                                           \
    const int begin = base + stride + (int)get_group_id(0) * PART;                                         \
    const int end = LESSER(begin + PART, base + stride * (rows + 1));
#define EACH_OF_PART for (int i = begin + (int)get_local_id(0); i < end; i += SUMS)
#define WRITE_SUM(place, sum)                                                                              \
    barrier(CLK_LOCAL_MEM_FENCE);                                                                          \
    scratch[get_local_id(0)] = sum;                                                                        \
    GROUP_SUM(scratch, SUMS)                                                                               \
    if (get_local_id(0) == 0) parts[(place) + get_group_id(0)] = scratch[0];
#define ADD_UP(sum, from, number)                                                                          \
    value sum = 0;                                                                                         \
    for (int k = get_local_id(0); k < (number); k += (int)get_local_size(0)) sum += (from)[k];             \
    barrier(CLK_LOCAL_MEM_FENCE);                                                                          \
    scratch[get_local_id(0)] = sum;                                                                        \
    GROUP_SUM(scratch, (int)get_local_size(0))                                                             \
    barrier(CLK_LOCAL_MEM_FENCE);                                                                          \
    sum = scratch[0];
#else
#define SUM_GROUP
#define ADD_UP(sum, from, number)                                                                          \
    value sum = 0;                                                                                         \
    for (int k = 0; k < (number); ++k) sum += (from)[k];
#define PART_NODES                                                                                         \
    const int begin = base + stride + (int)get_global_id(0) * PART;                                        \
    const int end = LESSER(begin + PART, base + stride * (rows + 1));
#define EACH_OF_PART for (int i = begin; i < end; i += WIDTH)
#define WRITE_SUM(place, sum) if (begin < end) parts[(place) + get_global_id(0)] = WHOLE(sum);
#endif
#define EACH_PART                                                                                          \
    PART_NODES                                                                                             \
    values sum = 0;                                                                                        \
    EACH_OF_PART
#define WRITE_PART WRITE_SUM(0, sum)

// The next direction, and its product with the matrix times it. The previous step, along the previous
// direction, is applied here, because that is read anyway: from zero if `step` is 1, from x if 2.
#define DIRECTION(i) (AT(z + (i)) + factor * AT(before + (i)))
#define TAKEN(length, along) ((step == 1 ? (values)0 : AT(x + i)) + ALONG(length, AT(along + i)))
__kernel SUM_GROUP void multigrid_direct(
    LEVEL_ARGS, const int cycle, const int step, GRAPH_ARGS, MAP inverse, const int products, VALUES product, const int count,
    VALUES squares, OUT_VALUES history, VALUES z, VALUES before, OUT_VALUES direction, OUT_VALUES x, OUT_VALUES parts)
{
    PART_NODES
    ADD_UP(bz, product, products)
    const value factor = cycle > 0 ? RATIO(bz, HISTORY(cycle - 1, 0)) : 0, length = cycle > 0 ? HISTORY(cycle - 1, 1) : 0;
    ADD_UP(square, squares, count)
    if (get_global_id(0) == 0) {
        HISTORY(cycle, 0) = bz;
        HISTORY(cycle, 2) = square;
    }
    values sum = 0;
    EACH_LIVE {
        SIDES
        // never infinite: it may be read at nodes without links later
        const values p = bz > 0 ? DIRECTION(i) : (values)0;
        STREAM(direction + i, p);
        sum += p * -FLOW(DIRECTION, i, stride);
        if (step) PUT(x + i) = TAKEN(length, before);
    }
    WRITE_PART
}

// The residual after a step along it, and its square.
__kernel SUM_GROUP void multigrid_advance(
    LEVEL_ARGS, const int cycle, GRAPH_ARGS, MAP inverse, VALUES moving, const int count, VALUES products, OUT_VALUES history,
    VALUES direction, OUT_VALUES b, OUT_VALUES parts)
{
    PART_NODES
    ADD_UP(product, products, count)
    const value length = *moving * RATIO(HISTORY(cycle, 0), product);
    if (get_global_id(0) == 0) HISTORY(cycle, 1) = length;
    values sum = 0;
    EACH_LIVE {
        SIDES
        const values image = -FLOW(AT, direction + i, stride), r = AT(b + i) - ALONG(length, image);
        PUT(b + i) = r;
        sum += r * r;
    }
    WRITE_PART
}

// A step without a following direction.
__kernel void multigrid_take(LEVEL_ARGS, const int cycle, const int step, VALUES history, VALUES direction, OUT_VALUES x)
{
    ITEMS_NODES
    EACH_NODE {
        PUT(x + i) = TAKEN(HISTORY(cycle, 1), direction);
    }
}

// Pieces of the rows of a map without margins.
#define PICTURE_ITEMS                                                                                      \
    const int pieces = (columns + TILE - 1) / TILE, row = get_global_id(0) / pieces;                       \
    const int from = get_global_id(0) % pieces * TILE, upto = LESSER(columns, from + TILE);                \
    if (row >= rows) return;

#if LANES == 1
// The links of a picture, and the weights of known heights.
#if ANCHORED
#define ANCHORS MAP anchors, OUT anchor,
#else
#define ANCHORS
#endif
__kernel void multigrid_admit_graph(
    LEVEL_ARGS, const int columns, ANCHORS MAP level, MAP map, OUT right, OUT down)
{
    PICTURE_ITEMS
    for (int c = from; c < upto; ++c) {
        const int i = base + (row + 1) * stride + c, p = row * columns + c;
        right[i] = level[p];
        down[i] = map[p];
#if ANCHORED
        anchor[i] = anchors[p];
#endif
    }
}

// Heights of nodes that have slopes but had no link: means of those that nodes in a square around imply, with the mean of
// both slopes, weighted by the inverse of their squared distances. `right` and `down` are still the last graph's.
#define SIDE 3
#define HAD_LINK(i) ((right[i] > 0) | (right[(i) - 1] > 0) | (down[i] > 0) | (down[(i) - stride] > 0))
#define ENTERS(i, p) ((map[p] == map[p]) & !HAD_LINK(i))
__kernel void multigrid_enter(
    LEVEL_ARGS, const int columns, const float step_x, const float step_y, MAP right, MAP down, MAP map, MAP dz_dy,
    __global float *level)
{
    PICTURE_ITEMS
    for (int c = from; c < upto; ++c) {
        const int i = base + (row + 1) * stride + c, p = row * columns + c;
#if WIDTH > 1  // few enter
        int some = c + WIDTH > upto;
        for (int k = 0; k < WIDTH && c + WIDTH <= upto; ++k) some |= ENTERS(i + k, p + k);
        if (!some) {
            c += WIDTH - 1;
            continue;
        }
#endif
        if (!ENTERS(i, p)) continue;
        float sum = 0, weights = 0;
        for (int y = -LESSER(SIDE, row); y <= LESSER(SIDE, rows - 1 - row); ++y)
            for (int x = -LESSER(SIDE, c); x <= LESSER(SIDE, columns - 1 - c); ++x) {
                const int j = i + y * stride + x, q = p + y * columns + x;
                if (map[q] != map[q] || !HAD_LINK(j)) continue;
                const float rise = 0.5f * (x * step_x * (map[p] + map[q]) + y * step_y * (dz_dy[p] + dz_dy[q]));
                const float weight = 1.0f / (x * x + y * y);
                sum += weight * (level[j] - rise);
                weights += weight;
            }
        if (weights > 0) level[i] = sum / weights;
    }
}

// The last step, and the map of the heights.
__kernel void multigrid_finish(
    LEVEL_ARGS, const int columns, const int cycle, const int step, VALUES history, VALUES direction, OUT level, OUT map)
{
    PICTURE_ITEMS
    for (int c = from; c < upto; ++c) {
        const int i = base + (row + 1) * stride + c;
        const float before = step == 1 ? 0 : level[i];
        map[row * columns + c] = level[i] = before + (step && HISTORY(cycle, 1) != 0 ? HISTORY(cycle, 1) * direction[i] : 0);
    }
}

// A live step has one right-hand side. For the result z of a cycle and the previous step p: z A z, z A p, p A
// p and b p.
#define STEP(i) AT(p + (i))
#define CORRECTION(i) AT(z + (i))
__kernel SUM_GROUP void multigrid_curve(
    LEVEL_ARGS, GRAPH_ARGS, MAP inverse, MAP b, MAP z, MAP p, const int count, OUT parts)
{
    PART_NODES
    reals zz = 0, zp = 0, pp = 0, bp = 0;
    EACH_OF_PART {
        bp += AT(b + i) * STEP(i);
        if (ALONE) continue;
        SIDES
        const reals along = -FLOW(STEP, i, stride);
        zz -= CORRECTION(i) * FLOW(CORRECTION, i, stride);
        zp += CORRECTION(i) * along;
        pp += STEP(i) * along;
    }
    WRITE_SUM(0, zz)
    WRITE_SUM(count, zp)
    WRITE_SUM(2 * count, pp)
    WRITE_SUM(3 * count, bp)
}

// The step lengths along both that minimise the energy in their plane, from the parts of these products and
// of b z, reduced by one group. No sum is copied to the host.
#define INDEPENDENT 1e-4f  // minimum share of the products' determinant for which both directions are used
__kernel GROUP_SIZE void multigrid_best(const int products, MAP product, const int count, MAP parts, OUT lengths)
{
    __local float scratch[GROUP];
    ADD_UP(bz, product, products)
    ADD_UP(zz, parts, count)
    ADD_UP(zp, parts + count, count)
    ADD_UP(pp, parts + 2 * count, count)
    ADD_UP(bp, parts + 3 * count, count)
    const float whole = zz * pp, determinant = whole - zp * zp;
    const int both = whole > 0 && determinant > INDEPENDENT * whole;
    if (get_local_id(0)) return;
    lengths[0] = both ? (bz * pp - bp * zp) / determinant : zz > 0 ? bz / zz : 0;
    lengths[1] = both ? (bp * zz - bz * zp) / determinant : 0;
}

// The step of these lengths along both.
__kernel void multigrid_follow(LEVEL_ARGS, MAP lengths, MAP z, OUT p, OUT x)
{
    ITEMS_NODES
    EACH_NODE {
        const reals step = lengths[0] * CORRECTION(i) + lengths[1] * STEP(i);
        PUT(p + i) = step;
        PUT(x + i) = AT(x + i) + step;
    }
}
#endif

// The product of two vectors.
__kernel SUM_GROUP void multigrid_dot(LEVEL_ARGS, VALUES one, VALUES other, OUT_VALUES parts)
{
    EACH_PART {
        sum += AT(one + i) * AT(other + i);
    }
    WRITE_PART
}

// The heights times the weights of the anchors.
__kernel SUM_GROUP void multigrid_weigh(LEVEL_ARGS, MAP anchor, VALUES x, OUT_VALUES parts)
{
    EACH_PART {
        sum += AT(anchor + i) * AT(x + i) * AT(x + i);
    }
    WRITE_PART
}

// Maps of pixels without margins, to and from the finest level.
#if LANES == 1
__kernel void multigrid_admit(LEVEL_ARGS, const int columns, MAP map, OUT level)
{
    PICTURE_ITEMS
    for (int c = from; c < upto; ++c) {
        level[base + (row + 1) * stride + c] = map[row * columns + c];
    }
}

__kernel void multigrid_release(LEVEL_ARGS, const int columns, MAP level, OUT map)
{
    PICTURE_ITEMS
    for (int c = from; c < upto; ++c) {
        map[row * columns + c] = level[base + (row + 1) * stride + c];
    }
}
#else
// `count` maps from `first` on, one below the other; further lanes are empty. Pieces of a row are
// interleaved, because caches hold few parts of maps at equal distances.
#define PIECE LESSER(TILE, 64)
__kernel void multigrid_admit(
    LEVEL_ARGS, const int columns, const int first, const int count, MAP map, OUT level)
{
    PICTURE_ITEMS
    float some[LANES][PIECE];
    for (int c = from; c < upto; c += PIECE) {
        const int width = LESSER(PIECE, upto - c);
        for (int lane = 0; lane < LANES; ++lane)
            for (int k = 0; k < width; ++k)
                some[lane][k] = lane < count ? map[((long)(first + lane) * rows + row) * columns + c + k] : 0;
        for (int k = 0; k < width; ++k)
            for (int lane = 0; lane < LANES; ++lane)
                level[(base + (long)(row + 1) * stride + c + k) * LANES + lane] = some[lane][k];
    }
}

__kernel void multigrid_release(
    LEVEL_ARGS, const int columns, const int first, const int count, MAP level, OUT map)
{
    PICTURE_ITEMS
    for (int c = from; c < upto; c += PIECE) {
        const int width = LESSER(PIECE, upto - c);
        for (int lane = 0; lane < count; ++lane)
            for (int k = 0; k < width; ++k)
                map[((long)(first + lane) * rows + row) * columns + c + k] = level[(base + (long)(row + 1) * stride + c + k) * LANES + lane];
    }
}
#endif

// --- Variances --------------------------------------------------------------------------------------------------

// The number of pixels with a flag of `flag` in each node of a level: each pixel is followed from aggregate
// to aggregate.
__kernel void multigrid_masses(
    LEVEL_ARGS, const int columns, __global const Level *restrict levels, const int number, COUNTS changes, BYTES to,
    const int flag, BYTES map, __global int *restrict level)
{
    PICTURE_ITEMS
    int last = -1, sum = 0;
    for (int c = from; c <= upto; ++c) {
        int y = row, x = c, node = -1;
        if (c < upto && map[row * columns + c] & flag) {
            for (int l = 0; l < number; ++l) {
                const int i = levels[l].base + levels[l].stride * (y + 1) + x, moved = changes[l] > 0;
                y = (y >> 1) + (moved ? WENT_DOWN(i) : 0);
                x = (x >> 1) + (moved ? WENT_RIGHT(i) : 0);
            }
            node = levels[number].stride * (y + 1) + x;
        }
        if (node != last && last >= 0) atomic_add(level + last, sum);
        sum = node == last ? sum + 1 : 1;
        last = node;
    }
}

// The variance on a level of at most LINE nodes per side: the diagonal of the inverse G of its matrix. For a component without
// anchors, the mean over its pixels is 0: with the masses m and their sum M, the diagonal is that of G, minus 2 G m / M, plus
// m G m / M^2, where G fixes one node at 0.
//
// Rows are eliminated from the first to the last (block tridiagonal). In a row, the sweep of node k converts weights to later
// nodes into shares p of the flow through k, and adds p p / d for nodes already swept. Nothing is subtracted, as in
// `invert_coarsest`. Right-hand sides are swept as further rows of m: weights to the next row, anchors, masses, and the sums of
// squares m^2 / d, which finally are m G m. The last node of a component without anchors has pivot 0: it receives all masses, and
// returns them (`whole`) with m G m (`squares`). From the last row to the first, G + (G L) G' (L G) is the inverse G of a row
// and all rows after it, where G' is that of the next row, and L are the links to it.
#define LINE 64
#define EACH_ELEMENT(count)                                                                                \
    for (int e = get_local_id(0) * WIDTH, a = e / stride, c = e % stride; e < (count) * stride;            \
         e += GROUP * WIDTH, a = e / stride, c = e % stride)
#define EACH_IN_ROW(a) for (int a = get_local_id(0), n = first + a; a < stride; a += GROUP, n += GROUP)
#define OVER(w, v) ((w) > 0 ? (w) * (v) : 0)
#define FROM_ABOVE(v) (OVER(falling[n - stride - 1], v[n - stride - 1]) + OVER(down[n - stride], v[n - stride])            \
                       + OVER(rising[n - stride + 1], v[n - stride + 1]))
#define FROM_BELOW(v) (OVER(rising[n], v[n + stride - 1]) + OVER(down[n], v[n + stride]) + OVER(falling[n], v[n + stride + 1]))
#define ACROSS_LINKS(READ, p) (before * READ((p) - 1) + here * READ(p) + after * READ((p) + 1))
#define BETWEEN_LINKS(READ, p, w, v, u)                                                                    \
    ((w) * ACROSS_LINKS(READ, (p) - stride) + (v) * ACROSS_LINKS(READ, p) + (u) * ACROSS_LINKS(READ, (p) + stride))
__kernel GROUP_SIZE void multigrid_exact(
    LEVEL_ARGS, GRAPH_ARGS, COUNTS masses, __global float *restrict inverses, __global float *restrict work,
    __global float *restrict held, __global float *restrict swept_sum, __global float *restrict whole,
    __global float *restrict squares, __global float *restrict variance)
{
    __local float elements[LINE * (LINE + 7)], column[LINE + 4 + WIDTH], swept[LINE];
    __local float *m = elements + 2 * LINE;
    for (int k = get_local_id(0); k < LINE * (LINE + 7); k += GROUP) elements[k] = 0;
    FENCE
    for (int r = 0; r < rows; ++r) {
        const int first = base + stride * (r + 1);
        __global const float *G = inverses + 2 * LINE + (r - 1) * stride * stride;  // of the row above
        EACH_ELEMENT(r ? stride : 0) {
            const int i = first + c, n = first + a;
            const reals before = AT(falling + i - stride - 1), here = AT(down + i - stride), after = AT(rising + i - stride + 1);
            PUT_NEAR(m + e) =
                BETWEEN_LINKS(AT, G + e, falling[n - stride - 1], down[n - stride], rising[n - stride + 1]);
        }
        EACH_IN_ROW(a) {
            m[stride * stride + a] = rising[n] + down[n] + falling[n];
            m[(stride + 1) * stride + a] = (r ? FROM_ABOVE(held) : 0) WITH_ANCHOR(anchor[n]);
            m[(stride + 2) * stride + a] = (r ? FROM_ABOVE(swept_sum) : 0) + GREATER(masses[n - base], 1);
            m[(stride + 3) * stride + a] = r ? FROM_ABOVE(variance) : 0;
            whole[n] = squares[n] = 0;
        }
        NEAR_BARRIER
        EACH_IN_ROW(a) {
            if (a + 1 == stride) continue;
            m[a * stride + a + 1] += right[n];
            m[(a + 1) * stride + a] += right[n];
        }
        NEAR_BARRIER
        for (int k = 0; k < stride; ++k) {
            float pivot = m[stride * stride + k] + m[(stride + 1) * stride + k];
            for (int j = k + 1; j < stride; ++j) pivot += m[k * stride + j];
            const float inverse = INVERSE(pivot);
            NEAR_BARRIER
            if (get_local_id(0) == 0) swept[k] = pivot > 0;
            const int count = pivot > 0 ? stride + 4 : 0;  // no barrier is skipped
            for (int a = get_local_id(0); a < stride && count == 0; a += GROUP) {
                const float share = a == k ? 1 : m[a * stride + k];
                whole[first + a] += share * m[(stride + 2) * stride + k];
                squares[first + a] += share * m[(stride + 3) * stride + k];
            }
            for (int a = get_local_id(0); a < count; a += GROUP) {
                const float mass = m[(stride + 2) * stride + k];
                column[a] = a == k ? 1 : m[a * stride + k] + (a == stride + 3 ? mass * mass * inverse : 0);
            }
            NEAR_BARRIER
            for (int a = get_local_id(0); a < count; a += GROUP) {
                m[a * stride + k] = 0;
                if (a < stride) m[k * stride + a] = 0;
            }
            NEAR_BARRIER
            EACH_ELEMENT(count) {
                if (column[a] != 0) PUT_NEAR(m + e) = NEAR(m + e) + inverse * column[a] * NEAR(column + c);
            }
            NEAR_BARRIER
        }
        EACH_IN_ROW(a) {
            held[n] = swept[a] * m[(stride + 1) * stride + a];
            swept_sum[n] = swept[a] * m[(stride + 2) * stride + a];
            variance[n] = swept[a] * m[(stride + 3) * stride + a];
        }
        EACH_ELEMENT(stride) PUT(inverses + 2 * LINE + r * stride * stride + e) = swept[a] * NEAR(swept + c) * NEAR(m + e);
        FENCE
    }
    for (int q = 0; q < rows; ++q) {
        const int r = rows - 1 - q;
        const int first = base + stride * (r + 1);
        __global const float *G = inverses + 2 * LINE + r * stride * stride;
        EACH_ELEMENT(r < rows - 1 ? stride : 0) {
            const int i = first + c, n = first + a;
            const reals before = AT(rising + i), here = AT(down + i), after = AT(falling + i);
            PUT(work + e) = BETWEEN_LINKS(NEAR, m + e, rising[n], down[n], falling[n]);
        }
        EACH_IN_ROW(a) {
            m[(stride + 2) * stride + a] = r < rows - 1 ? FROM_BELOW(swept_sum) : 0;
            column[a] = r < rows - 1 ? FROM_BELOW(whole) : 0;
            m[(stride + 3) * stride + a] = r < rows - 1 ? FROM_BELOW(squares) : 0;
        }
        FENCE
        EACH_ELEMENT(r < rows - 1 ? stride : 0) {
            reals sum = 0;
            for (int k = 0; k < stride; ++k) sum += G[a * stride + k] * AT(work + k * stride + c);
            PUT_NEAR(m + e) = sum;
        }
        EACH_IN_ROW(a) {
            for (int k = 0; k < stride; ++k) {
                swept_sum[n] += G[a * stride + k] * m[(stride + 2) * stride + k];
                whole[n] += G[a * stride + k] * column[k];
                squares[n] += G[a * stride + k] * m[(stride + 3) * stride + k];
            }
        }
        FENCE
        EACH_ELEMENT(stride) {
            reals sum = AT(G + e);
            for (int k = 0; k < stride && r < rows - 1; ++k) sum += m[a * stride + k] * AT(G + k * stride + c);
            PUT(work + e) = sum;
        }
        FENCE
        EACH_ELEMENT(stride) PUT_NEAR(m + e) = AT(work + e);
        NEAR_BARRIER
        EACH_IN_ROW(a) {
            const float all = whole[n], centred = all > 0 ? (squares[n] / all - 2 * swept_sum[n]) / all : 0;
            variance[n] = m[a * stride + a] + centred;
        }
    }
}

// The links, scaled along both axes such that those along x and y have the same mean weight.
#define MEAN(a, b) (((a) + (b)) * ((((a) > 0) & ((b) > 0)) ? (reals)0.5f : (reals)1))
#define EVENED_SIDES AXES EVENED_OF_SIDES
#define EVENED_OF_SIDES                                                                                    \
    const reals along_x = MEAN(to_right, to_left), along_y = MEAN(to_below, to_above);                     \
    const reals both = sqrt(along_x * along_y), one = (reals)1;                                            \
    const reals by_x = both > 0 ? both / along_x : one, by_y = both > 0 ? both / along_y : one;            \
    const reals go_right = by_x * to_right, go_left = by_x * to_left;                                      \
    const reals go_below = by_y * to_below, go_above = by_y * to_above;

// The inverse of the diagonal of these.
__kernel void multigrid_even(LEVEL_ARGS, GRAPH_ARGS, OUT evened)
{
    ITEMS_NODES
    EACH_NODE {
        EVENED_SIDES
        const reals diagonal = (go_right + go_left) + (go_below + go_above) WITH_ANCHOR(AT(anchor + i));
        PUT(evened + i) = INVERSE(diagonal);
    }
}

// The probability that a random walk along the links, by weight, has returned after two steps; and the values
// of the aggregates, prolonged to their nodes.
__kernel void multigrid_returns(
    LEVEL_ARGS, COARSE_ARGS, MAP right, MAP down, MAP evened, VALUES e, const int moved_nodes, BYTES to, OUT returns, OUT_VALUES t)
{
    ITEMS_NODES
    EACH_NODE {
        const int n = i - base - stride, J = coarse_base + coarse_stride * (n / stride / 2 + 1) + n % stride / 2;
        PUT(t + i) = injected(i, J, coarse_stride, e, moved_nodes, to);
        EVENED_SIDES
        PUT(returns + i) = AT(evened + i)
            * ((go_right * go_right * AT(evened + i + 1) + go_left * go_left * AT(evened + i - 1))
               + (go_below * go_below * AT(evened + i + stride) + go_above * go_above * AT(evened + i - stride)));
    }
}

// The variance: that of the aggregates, smoothed by a Jacobi step, and the local part.
#define BESIDE(i) (AT(evened + (i)) * (c3 + c4 * AT(returns + (i))) + here * AT(returns + (i)))
__kernel void multigrid_spread(
    LEVEL_ARGS, GRAPH_ARGS, MAP inverse, MAP evened, MAP returns, const float c0, const float c1, const float c2, const float c3,
    const float c4, const float c5, MAP t, OUT x)
{
    ITEMS_NODES
    EACH_NODE {
        SIDES
        EVENED_OF_SIDES
        const reals here = c2 * AT(evened + i);
        const reals odd = both > 0 ? 1 - 2 * both / (along_x + along_y) : 1 - one;
        const reals local_part = AT(evened + i)
            * ((c0 + c1 * AT(returns + i) + c5 * odd) + (go_right * BESIDE(i + 1) + go_left * BESIDE(i - 1))
               + (go_below * BESIDE(i + stride) + go_above * BESIDE(i - stride)));
        PUT(x + i) = local_part + AT(t + i) + AT(inverse + i) * FLOW(AT, t + i, stride);
    }
}

// Standard deviations: roots of variances, which are at least a share of the inverse diagonal; NaN without a
// flag of `flag`.
__kernel void multigrid_deviation(
    LEVEL_ARGS, const int columns, const float min_variance, const int flag,
    BYTES flags, MAP inverse, MAP level, OUT map)
{
    PICTURE_ITEMS
    for (int c = from; c < upto; ++c) {
        const int i = base + (row + 1) * stride + c;
        const float variance = GREATER(level[i], min_variance * inverse[i]);
        map[row * columns + c] = flags[row * columns + c] & flag ? sqrt(variance) : NAN;
    }
}
