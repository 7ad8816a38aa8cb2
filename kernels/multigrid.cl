// Heights on a graph of pixels, by multigrid: the passes over one level. Specification: multigrid.py.
//
// TILE      nodes of one work-item, a multiple of WIDTH
// WIDTH     nodes side by side in a vector: 8, or 1 where an item is a lane
// PART      nodes of one part of a sum
// ANCHORED  1 where there are known heights, 0 where there are none
//
// All levels lie one after the other in the same arrays. A level begins at `base` with a row of nodes that are
// none, then come its rows of `stride` nodes, a multiple of 16, then another row of none: so every node has four
// neighbours in memory, and where there is no link its weight is 0. Extra nodes, which have no place in the
// picture because their block has more than one, lie behind all levels; whatever has to do with them is done by
// the passes for extra nodes, row by row of a sparse matrix, over what the plain passes wrote there.

#include "common.clh"

#if WIDTH == 8
typedef float8 reals;
typedef float8 __attribute__((aligned(4))) loose;  // somewhere in memory
#define AT(p) (*(__global const loose *)(p))
#define PUT(p) *(__global loose *)(p)
#define EVEN(p) ((float8)(AT(p).even, AT((p) + 8).even))
#define ODD(p) ((float8)(AT(p).odd, AT((p) + 8).odd))
#define PUT_BOTH(p, one, two)                                                                              \
    PUT(p) = (float8)(one.s0, two.s0, one.s1, two.s1, one.s2, two.s2, one.s3, two.s3);                     \
    PUT((p) + 8) = (float8)(one.s4, two.s4, one.s5, two.s5, one.s6, two.s6, one.s7, two.s7);
#define WHOLE(v) (((v.s0 + v.s1) + (v.s2 + v.s3)) + ((v.s4 + v.s5) + (v.s6 + v.s7)))
#else
typedef float reals;
#define AT(p) (*(p))
#define PUT(p) *(p)
#define EVEN(p) ((p)[0])
#define ODD(p) ((p)[1])
#define PUT_BOTH(p, one, two) (p)[0] = one; (p)[1] = two;
#define WHOLE(v) (v)
#endif

// Nodes from `begin` to `end`, which an item takes of a level, and blocks of a coarse row.
#define ITEMS_NODES                                                                                        \
    const int begin = base + stride + (int)get_global_id(0) * TILE;                                        \
    const int end = LESSER(begin + TILE, base + stride * (rows + 1));
#define EACH_NODE for (int i = begin; i < end; i += WIDTH)

// Coarse nodes J of one row, each of the fine nodes I and I + 1 and of K and K + 1 below them.
#define EACH_BLOCK                                                                                         \
    for (int J = coarse_base + coarse_stride * (row + 1), I = base + stride * (2 * row + 1), K = I + stride, \
             last = J + stride / 2; J < last; J += WIDTH, I += 2 * WIDTH, K += 2 * WIDTH)

#if ANCHORED
#define WITH_ANCHOR(value) + (value)
#else
#define WITH_ANCHOR(value)
#endif

#define LEVEL_ARGS const int base, const int rows, const int stride
#define BETWEEN_ARGS const int base, const int stride, const int coarse_base, const int coarse_rows, const int coarse_stride
#define GRAPH_ARGS MAP right, MAP down, MAP anchor

#define INVERSE(value) ((value) > 0 ? 1 / (value) : 0)

// The links of nodes i: to the right and left, down and up.
#define LINKS                                                                                              \
    const reals to_right = AT(right + i), to_left = AT(right + i - 1);                                     \
    const reals to_below = AT(down + i), to_above = AT(down + i - stride);

#define DIAGONAL ((to_right + to_left) + (to_below + to_above) WITH_ANCHOR(AT(anchor + i)))

// What flows to nodes along their links, and to their anchors: -A x. X gives heights, of which those of the nodes,
// above and below them lie at c, a and b.
#define FLOW(X, a, c, b)                                                                                   \
    ((to_right * (X(c + 1) - X(c)) + to_left * (X(c - 1) - X(c))) + (to_below * (X(b) - X(c))              \
     + to_above * (X(a) - X(c))) WITH_ANCHOR(-AT(anchor + i) * X(c)))
#define FLOWING(X) FLOW(X, i - stride, i, i + stride)

#define HEIGHT(i) AT(x + (i))

// One over the diagonal.
__kernel void multigrid_invert(LEVEL_ARGS, GRAPH_ARGS, OUT inverse)
{
    ITEMS_NODES
    EACH_NODE {
        LINKS
        const reals diagonal = DIAGONAL;
        PUT(inverse + i) = INVERSE(diagonal);
    }
}

// Two steps of Jacobi's method from heights of zero.
#define FIRST(i) (omega * AT(b + (i)) * AT(inverse + (i)))
void begin_nodes(
    const int begin, const int end, const int stride, const float omega, const float then, GRAPH_ARGS, MAP inverse,
    MAP b, OUT x)
{
    EACH_NODE {
        LINKS
        PUT(x + i) = FIRST(i) + then * AT(inverse + i) * (AT(b + i) + FLOWING(FIRST));
    }
}

__kernel void multigrid_begin(LEVEL_ARGS, const float omega, const float then, GRAPH_ARGS, MAP inverse, MAP b, OUT x)
{
    ITEMS_NODES
    begin_nodes(begin, end, stride, omega, then, right, down, anchor, inverse, b, x);
}

// One step of Jacobi's method.
void smooth_nodes(
    const int begin, const int end, const int stride, const float omega, GRAPH_ARGS, MAP b, MAP x, OUT smoother)
{
    EACH_NODE {
        LINKS
        const reals diagonal = DIAGONAL;
        PUT(smoother + i) = HEIGHT(i) + omega * (AT(b + i) + FLOWING(HEIGHT)) * INVERSE(diagonal);
    }
}

__kernel void multigrid_smooth(LEVEL_ARGS, const float omega, GRAPH_ARGS, MAP b, MAP x, OUT smoother)
{
    ITEMS_NODES
    smooth_nodes(begin, end, stride, omega, right, down, anchor, b, x, smoother);
}

// The residual, b - A x.
void residual_nodes(const int begin, const int end, const int stride, GRAPH_ARGS, MAP b, MAP x, OUT residual)
{
    EACH_NODE {
        LINKS
        PUT(residual + i) = AT(b + i) + FLOWING(HEIGHT);
    }
}

__kernel void multigrid_residual(LEVEL_ARGS, GRAPH_ARGS, MAP b, MAP x, OUT residual)
{
    ITEMS_NODES
    residual_nodes(begin, end, stride, right, down, anchor, b, x, residual);
}

// The residual becomes the right side, and the heights so far are kept.
void keep_nodes(const int begin, const int end, MAP residual, MAP x, OUT b, OUT kept)
{
    EACH_NODE {
        PUT(b + i) = AT(residual + i);
        PUT(kept + i) = HEIGHT(i);
    }
}

__kernel void multigrid_keep(LEVEL_ARGS, MAP residual, MAP x, OUT b, OUT kept)
{
    ITEMS_NODES
    keep_nodes(begin, end, residual, x, b, kept);
}

// The residual over the diagonal.
void scaled_residual_nodes(const int begin, const int end, const int stride, GRAPH_ARGS, MAP b, MAP x, OUT residual)
{
    EACH_NODE {
        LINKS
        const reals diagonal = DIAGONAL;
        PUT(residual + i) = (AT(b + i) + FLOWING(HEIGHT)) * INVERSE(diagonal);
    }
}

__kernel void multigrid_scaled_residual(LEVEL_ARGS, GRAPH_ARGS, MAP b, MAP x, OUT residual)
{
    ITEMS_NODES
    scaled_residual_nodes(begin, end, stride, right, down, anchor, b, x, residual);
}

// The residual of heights of zero, over the diagonal.
void scale_nodes(const int begin, const int end, MAP inverse, MAP b, OUT residual)
{
    EACH_NODE {
        PUT(residual + i) = AT(inverse + i) * AT(b + i);
    }
}

__kernel void multigrid_scale(LEVEL_ARGS, MAP inverse, MAP b, OUT residual)
{
    ITEMS_NODES
    scale_nodes(begin, end, inverse, b, residual);
}

// Nothing, where no pass writes what others read.
__kernel void multigrid_clear(LEVEL_ARGS, OUT x)
{
    ITEMS_NODES
    EACH_NODE {
        PUT(x + i) = 0;
    }
}

// Heights and others.
void add_nodes(const int begin, const int end, MAP other, OUT x)
{
    EACH_NODE {
        PUT(x + i) += AT(other + i);
    }
}

__kernel void multigrid_add(LEVEL_ARGS, MAP other, OUT x)
{
    ITEMS_NODES
    add_nodes(begin, end, other, x);
}

// The coarse right side: the residual of a block's nodes, once a step of Jacobi's method has spread it. Of each
// link that enters the block the far end counts, and of those inside both. The residual lies, of the
// row above the block, its own two and the one below, at `above` to `below`.
void restrict_row(
    const int I, const int K, const int J, const int count, const int stride, MAP right, MAP down, MAP above, MAP upper,
    MAP lower, MAP below, OUT b)
{
    for (int c = 0; c < count; c += WIDTH) {
        const int f = 2 * c, i = I + f, k = K + f;
        const reals one = EVEN(upper + f), two = ODD(upper + f), three = EVEN(lower + f), four = ODD(lower + f);
        const reals top = EVEN(right + i) * (one + two) + EVEN(right + i - 1) * EVEN(upper + f - 1)
            + ODD(right + i) * ODD(upper + f + 1);
        const reals bottom = EVEN(right + k) * (three + four) + EVEN(right + k - 1) * EVEN(lower + f - 1)
            + ODD(right + k) * ODD(lower + f + 1);
        const reals before = EVEN(down + i) * (one + three) + EVEN(down + i - stride) * EVEN(above + f)
            + EVEN(down + k) * EVEN(below + f);
        const reals after = ODD(down + i) * (two + four) + ODD(down + i - stride) * ODD(above + f)
            + ODD(down + k) * ODD(below + f);
        PUT(b + J + c) = (top + bottom) + (before + after);
    }
}

#define RESTRICT_ROW                                                                                       \
    const int I = base + stride * (2 * row + 1), K = I + stride, J = coarse_base + coarse_stride * (row + 1); \
    restrict_row(I, K, J, stride / 2, stride, right, down, residual + I - stride, residual + I, residual + K,       \
                 residual + K + stride, b);

__kernel void multigrid_restrict(BETWEEN_ARGS, MAP right, MAP down, MAP residual, OUT b)
{
    const int row = get_global_id(0);
    if (row < coarse_rows) {
        RESTRICT_ROW
    }
}

// The coarse right side of full multigrid, where no block is split: the sum over each block.
void gather_row(
    const int row, const int base, const int stride, const int coarse_base, const int coarse_stride, MAP fine, OUT b)
{
    EACH_BLOCK {
        PUT(b + J) = (EVEN(fine + I) + ODD(fine + I)) + (EVEN(fine + K) + ODD(fine + K));
    }
}

__kernel void multigrid_gather(BETWEEN_ARGS, MAP fine, OUT b)
{
    const int row = get_global_id(0);
    if (row < coarse_rows) gather_row(row, base, stride, coarse_base, coarse_stride, fine, b);
}

// Heights and the coarse correction, spread by a step of Jacobi's method.
void prolong_row(
    const int row, const int base, const int stride, const int coarse_base, const int coarse_stride, const float keep,
    MAP right, MAP down, MAP inverse, MAP e, MAP x, OUT upper, OUT lower)
{
    EACH_BLOCK {
        const reals here = AT(e + J), above = AT(e + J - coarse_stride), below = AT(e + J + coarse_stride);
        const reals before = AT(e + J - 1), after = AT(e + J + 1);
        const reals a = keep * EVEN(x + I) + EVEN(inverse + I) * (EVEN(right + I) * here
            + EVEN(right + I - 1) * before + EVEN(down + I) * here + EVEN(down + I - stride) * above);
        const reals b = keep * ODD(x + I) + ODD(inverse + I) * (ODD(right + I) * after
            + EVEN(right + I) * here + ODD(down + I) * here + ODD(down + I - stride) * above);
        const reals c = keep * EVEN(x + K) + EVEN(inverse + K) * (EVEN(right + K) * here
            + EVEN(right + K - 1) * before + EVEN(down + K) * below + EVEN(down + I) * here);
        const reals d = keep * ODD(x + K) + ODD(inverse + K) * (ODD(right + K) * after
            + EVEN(right + K) * here + ODD(down + K) * below + ODD(down + I) * here);
        PUT_BOTH(upper, a, b)
        PUT_BOTH(lower, c, d)
        upper += 2 * WIDTH;
        lower += 2 * WIDTH;
    }
}

#define PROLONG_ROW                                                                                        \
    __global float *upper = corrected + base + stride * (2 * row + 1), *lower = upper + stride;            \
    prolong_row(row, base, stride, coarse_base, coarse_stride, keep, right, down, inverse, e, x, upper, lower);

__kernel void multigrid_prolong(
    BETWEEN_ARGS, const float keep, MAP right, MAP down, MAP inverse, MAP e, MAP x, OUT corrected)
{
    const int row = get_global_id(0);
    if (row < coarse_rows) {
        PROLONG_ROW
    }
}

// The coarse links and anchors, and 1 where a block's nodes do not hang together by links of at least `strength` of the
// geometric mean of their nodes' greatest ones. A link stands for a way
// from the middle of its block to that of the next: in either goes on by half a link that lies behind it, or around by
// the other row's; where neither is, by half a link as well.
#define GREATEST(PICK, i)                                                                                  \
    GREATER(GREATER(PICK(right + (i)), PICK(right + (i) - 1)), GREATER(PICK(down + (i)), PICK(down + (i) - stride)))
#define GO_ON(w, behind, across, beside)                                                                   \
    ((behind) > 0 ? 1 / ((w) + (behind)) : (((across) > 0) & ((beside) > 0)) ? 1 / (beside) : 0.5f / (w))
#define IN_SERIES(w, before, after) ((w) > 0 ? 1 / (1 / (w) + (before) + (after)) : 0)
#define COUNT(condition) ((condition) ? (reals)1 : (reals)0)
#define STRONG(w, g, h) COUNT(((w) > 0) & ((w) * (w) >= strength * strength * (g) * (h)))
__kernel void multigrid_coarsen(
    BETWEEN_ARGS, const float strength, GRAPH_ARGS, OUT coarse_right, OUT coarse_down, OUT coarse_anchor, OUT split)
{
    const int row = get_global_id(0);
    if (row >= coarse_rows) return;
    EACH_BLOCK {
        const reals a = GREATEST(EVEN, I), b = GREATEST(ODD, I), c = GREATEST(EVEN, K), d = GREATEST(ODD, K);
        const reals ab = EVEN(right + I), cd = EVEN(right + K), ac = EVEN(down + I), bd = ODD(down + I);
        const reals from_b = ODD(right + I), from_d = ODD(right + K), under_c = EVEN(down + K), under_d = ODD(down + K);
        const reals next_ab = EVEN(right + I + 2), next_cd = EVEN(right + K + 2), next_ac = EVEN(down + I + 2);
        const int M = row + 1 < coarse_rows ? K + stride : K;  // below the last row the coarse level may begin
        const reals low_ab = EVEN(right + M), low_ac = EVEN(down + M), low_bd = ODD(down + M);
        const reals live = COUNT(a > 0) + COUNT(b > 0) + COUNT(c > 0) + COUNT(d > 0);
        const reals joined = STRONG(ab, a, b) + STRONG(cd, c, d) + STRONG(ac, a, c) + STRONG(bd, b, d);
        PUT(coarse_right + J)
            = IN_SERIES(from_b, GO_ON(from_b, ab, bd, cd), GO_ON(from_b, next_ab, next_ac, next_cd))
            + IN_SERIES(from_d, GO_ON(from_d, cd, bd, ab), GO_ON(from_d, next_cd, next_ac, next_ab));
        PUT(coarse_down + J)
            = IN_SERIES(under_c, GO_ON(under_c, ac, cd, bd), GO_ON(under_c, low_ac, low_ab, low_bd))
            + IN_SERIES(under_d, GO_ON(under_d, bd, cd, ac), GO_ON(under_d, low_bd, low_ab, low_ac));
#if ANCHORED
        PUT(coarse_anchor + J) = (COUNT(a > 0) * EVEN(anchor + I) + COUNT(b > 0) * ODD(anchor + I))
            + (COUNT(c > 0) * EVEN(anchor + K) + COUNT(d > 0) * ODD(anchor + K));
#endif
        PUT(split + J) = COUNT(joined < live - 1);
    }
}

// The links, scaled along both axes so that those along x weigh as much on average as those along y.
#define MEAN(a, b) (((a) + (b)) * ((((a) > 0) & ((b) > 0)) ? (reals)0.5f : (reals)1))
#define EVENED_LINKS                                                                                       \
    LINKS                                                                                                  \
    const reals along_x = MEAN(to_right, to_left), along_y = MEAN(to_below, to_above);                     \
    const reals both = sqrt(along_x * along_y), one = (reals)1;                                            \
    const reals by_x = both > 0 ? both / along_x : one, by_y = both > 0 ? both / along_y : one;            \
    const reals go_right = by_x * to_right, go_left = by_x * to_left;                                      \
    const reals go_below = by_y * to_below, go_above = by_y * to_above;

// One over the diagonal of these.
__kernel void multigrid_even(LEVEL_ARGS, GRAPH_ARGS, OUT evened)
{
    ITEMS_NODES
    EACH_NODE {
        EVENED_LINKS
        const reals diagonal = (go_right + go_left) + (go_below + go_above) WITH_ANCHOR(AT(anchor + i));
        PUT(evened + i) = INVERSE(diagonal);
    }
}

// How likely a walk along them, which takes each as often as it weighs, is back where it was after two steps.
__kernel void multigrid_returns(LEVEL_ARGS, MAP right, MAP down, MAP evened, OUT returns)
{
    ITEMS_NODES
    EACH_NODE {
        EVENED_LINKS
        PUT(returns + i) = AT(evened + i)
            * ((go_right * go_right * AT(evened + i + 1) + go_left * go_left * AT(evened + i - 1))
               + (go_below * go_below * AT(evened + i + stride) + go_above * go_above * AT(evened + i - stride)));
    }
}

// What a node's variance has that the coarse one does not.
#define BESIDE(i) (AT(evened + (i)) * (c[3] + c[4] * AT(returns + (i))) + here * AT(returns + (i)))
__kernel void multigrid_local(
    LEVEL_ARGS, MAP right, MAP down, MAP evened, MAP returns, __global const float *restrict c, OUT local_part)
{
    ITEMS_NODES
    EACH_NODE {
        EVENED_LINKS
        const reals here = c[2] * AT(evened + i);
        const reals odd = both > 0 ? 1 - 2 * both / (along_x + along_y) : 1 - one;
        PUT(local_part + i) = AT(evened + i)
            * ((c[0] + c[1] * AT(returns + i) + c[5] * odd) + (go_right * BESIDE(i + 1) + go_left * BESIDE(i - 1))
               + (go_below * BESIDE(i + stride) + go_above * BESIDE(i - stride)));
    }
}

// The same passes for extra nodes: row k is of node[k], and SUM over its other nodes j of weight w.
#define EXTRA_TILE GREATER(TILE / 16, 1)
#define TABLE_ARGS __global const int *restrict node, __global const int *restrict start, __global const int *restrict column, MAP weight
#define ITEMS_EXTRA                                                                                          \
    const int begin = at + (int)get_global_id(0) * EXTRA_TILE, end = LESSER(begin + EXTRA_TILE, at + count);
#define EACH_EXTRA for (int k = begin; k < end; ++k)
#define SUM(sum, term)                                                                                     \
    float sum = 0;                                                                                         \
    for (int m = start[k]; m < start[k + 1]; ++m) {                                                        \
        const int j = column[m];                                                                           \
        const float w = weight[m];                                                                         \
        sum += term;                                                                                       \
    }

__kernel void multigrid_invert_extra(const int at, const int count, TABLE_ARGS, MAP anchor, OUT inverse)
{
    ITEMS_EXTRA
    EACH_EXTRA {
        SUM(diagonal, w)
        const float whole = diagonal WITH_ANCHOR(anchor[node[k]]);
        inverse[node[k]] = INVERSE(whole);
    }
}

#define SEED(i) (omega * b[i] * inverse[i])
void begin_extra(
    const int begin, const int end, TABLE_ARGS, const float omega, const float then, MAP anchor, MAP inverse, MAP b, OUT x)
{
    EACH_EXTRA {
        const int i = node[k];
        SUM(flow, w * (SEED(j) - SEED(i)))
        x[i] = SEED(i) + then * inverse[i] * (b[i] + flow WITH_ANCHOR(-anchor[i] * SEED(i)));
    }
}

__kernel void multigrid_begin_extra(
    const int at, const int count, TABLE_ARGS, const float omega, const float then, MAP anchor, MAP inverse, MAP b, OUT x)
{
    ITEMS_EXTRA
    begin_extra(begin, end, node, start, column, weight, omega, then, anchor, inverse, b, x);
}

void smooth_extra(
    const int begin, const int end, TABLE_ARGS, const float omega, MAP anchor, MAP inverse, MAP b, MAP x, OUT smoother)
{
    EACH_EXTRA {
        const int i = node[k];
        SUM(flow, w * (x[j] - x[i]))
        smoother[i] = x[i] + omega * inverse[i] * (b[i] + flow WITH_ANCHOR(-anchor[i] * x[i]));
    }
}

__kernel void multigrid_smooth_extra(
    const int at, const int count, TABLE_ARGS, const float omega, MAP anchor, MAP inverse, MAP b, MAP x, OUT smoother)
{
    ITEMS_EXTRA
    smooth_extra(begin, end, node, start, column, weight, omega, anchor, inverse, b, x, smoother);
}

// Over the diagonal, if there is one to divide by.
void residual_extra(
    const int begin, const int end, TABLE_ARGS, const int divide, MAP anchor, MAP inverse, MAP b, MAP x, OUT residual)
{
    EACH_EXTRA {
        const int i = node[k];
        SUM(flow, w * (x[j] - x[i]))
        residual[i] = (divide ? inverse[i] : 1) * (b[i] + flow WITH_ANCHOR(-anchor[i] * x[i]));
    }
}

__kernel void multigrid_residual_extra(
    const int at, const int count, TABLE_ARGS, const int divide, MAP anchor, MAP inverse, MAP b, MAP x, OUT residual)
{
    ITEMS_EXTRA
    residual_extra(begin, end, node, start, column, weight, divide, anchor, inverse, b, x, residual);
}

void restrict_extra(const int begin, const int end, TABLE_ARGS, MAP residual, OUT b)
{
    EACH_EXTRA {
        SUM(whole, w * residual[j])
        b[node[k]] = whole;
    }
}

__kernel void multigrid_restrict_extra(const int at, const int count, TABLE_ARGS, MAP residual, OUT b)
{
    ITEMS_EXTRA
    restrict_extra(begin, end, node, start, column, weight, residual, b);
}

void prolong_extra(const int begin, const int end, TABLE_ARGS, const float keep, MAP inverse, MAP e, MAP x, OUT corrected)
{
    EACH_EXTRA {
        const int i = node[k];
        SUM(whole, w * e[j])
        corrected[i] = keep * x[i] + inverse[i] * whole;
    }
}

__kernel void multigrid_prolong_extra(
    const int at, const int count, TABLE_ARGS, const float keep, MAP inverse, MAP e, MAP x, OUT corrected)
{
    ITEMS_EXTRA
    prolong_extra(begin, end, node, start, column, weight, keep, inverse, e, x, corrected);
}

__kernel void multigrid_returns_extra(const int at, const int count, TABLE_ARGS, MAP evened, OUT returns)
{
    ITEMS_EXTRA
    EACH_EXTRA {
        SUM(back, w * w * evened[j])
        returns[node[k]] = evened[node[k]] * back;
    }
}

__kernel void multigrid_local_extra(
    const int at, const int count, TABLE_ARGS, MAP evened, MAP returns, __global const float *restrict c, OUT local_part)
{
    ITEMS_EXTRA
    EACH_EXTRA {
        const int i = node[k];
        SUM(beside, w * (evened[j] * (c[3] + c[4] * returns[j]) + c[2] * evened[i] * returns[j]))
        local_part[i] = evened[i] * (c[0] + c[1] * returns[i] + beside);
    }
}

// The coarsest level: the pseudo-inverse of its matrix, times the right side of its nodes.
void solve_node(const int k, const int count, __global const int *restrict bottom, MAP matrix, MAP b, OUT x)
{
    float sum = 0;
    for (int m = 0; m < count; ++m) {
        sum += matrix[k * count + m] * b[bottom[m]];
    }
    x[bottom[k]] = sum;
}

__kernel void multigrid_solve(const int count, __global const int *restrict bottom, MAP matrix, MAP b, OUT x)
{
    const int k = get_global_id(0);
    if (k < count) solve_node(k, count, bottom, matrix, b, x);
}

#if WIDTH > 1
// Half a V-cycle over a large level without extra links, in one go: what passes hand on stays in the cache, in lines of
// an item's own. An item does a band of coarse rows, and at its borders what its neighbours do as well.
#define LINES 8
#define MARGIN 8
#define LINE(row) (mine + ((row) & 3) * width)
#define OTHER_LINE(row) (mine + (4 + ((row) & 3)) * width)
#define BAND                                                                                               \
    const int first = get_global_id(0) * band, last = LESSER(first + band, coarse_rows);                   \
    const int top = 2 * first, bottom = 2 * last, width = stride + 2 * MARGIN;                             \
    __global float *mine = lines + (int)get_global_id(0) * LINES * width + MARGIN;
#define EACH_OF_ROW(r) for (int c = 0, i = base + stride * ((r) + 1); c < stride; c += WIDTH, i += WIDTH)
#define IN_PICTURE(r) ((r) >= 0 && (r) < rows)
#define LINED(p) AT(p)

void clear_line(__global float *line, const int stride)
{
    for (int c = 0; c < stride; c += WIDTH) PUT(line + c) = 0;
}

// Two steps of Jacobi's method from heights of zero, the residual then, which is written if `keep` is 1, and the
// coarse right side.
__kernel void multigrid_descend(
    LEVEL_ARGS, const int coarse_base, const int coarse_rows, const int coarse_stride, const int band, const int keep,
    const float omega, const float then, GRAPH_ARGS, MAP inverse, MAP b, OUT x, OUT residual, OUT lines, OUT coarse_b)
{
    BAND
    if (first >= last) return;
    for (int r = top - 2; r <= bottom + 1; ++r) {
        __global float *line = LINE(r);
        if (!IN_PICTURE(r)) clear_line(line, stride);
        else EACH_OF_ROW(r) {
            LINKS
            const reals height = FIRST(i) + then * AT(inverse + i) * (AT(b + i) + FLOWING(FIRST));
            PUT(line + c) = height;
            if (r >= top && r < bottom) PUT(x + i) = height;
        }
        const int q = r - 1;
        if (q < top - 1) continue;
        __global float *over = OTHER_LINE(q), *middle = LINE(q), *above = LINE(q - 1), *below = LINE(q + 1);
        if (!IN_PICTURE(q)) clear_line(over, stride);
        else EACH_OF_ROW(q) {
            LINKS
            const reals rest = (AT(b + i) + FLOW(LINED, above + c, middle + c, below + c)) * AT(inverse + i);
            PUT(over + c) = rest;
            if (keep && q >= top && q < bottom) PUT(residual + i) = rest;
        }
        if (q > top && q % 2 == 0) {
            const int I = base + stride * (q - 1), J = coarse_base + coarse_stride * (q / 2);
            restrict_row(I, I + stride, J, stride / 2, stride, right, down, OTHER_LINE(q - 3), OTHER_LINE(q - 2),
                         OTHER_LINE(q - 1), over, coarse_b);
        }
    }
}

// The coarse correction and two steps of Jacobi's method, and parts of the product of heights and right side. The
// rows of the table for the prolongation to extra nodes that belong to a row of the picture begin at first_extra[row].
__kernel void multigrid_ascend(
    LEVEL_ARGS, const int coarse_base, const int coarse_rows, const int coarse_stride, const int band,
    const float omega, const float then, GRAPH_ARGS, MAP inverse, MAP b, MAP e, MAP x, OUT lines, OUT smoother,
    OUT parts, const int extras, __global const int *restrict first_extra, TABLE_ARGS)
{
    BAND
    if (first >= last) return;
    reals sum = 0;
    for (int row = first - 1; row <= last; ++row) {
        __global float *upper = LINE(2 * row), *lower = LINE(2 * row + 1);
        if (row < 0 || row >= coarse_rows) {
            clear_line(upper, stride);
            clear_line(lower, stride);
        } else {
            prolong_row(row, base, stride, coarse_base, coarse_stride, 1, right, down, inverse, e, x, upper, lower);
            for (int k = extras ? first_extra[2 * row] : 0; k < (extras ? first_extra[LESSER(2 * row + 2, rows)] : 0); ++k) {
                SUM(whole, w * e[j])
                const int i = node[k], r = (i - base) / stride - 1;
                LINE(r)[i - base - stride * (r + 1)] = x[i] + inverse[i] * whole;
            }
        }
        for (int q = GREATER(2 * row - 1, top - 1); q <= LESSER(2 * row, bottom); ++q) {
            __global float *line = OTHER_LINE(q), *middle = LINE(q), *above = LINE(q - 1), *below = LINE(q + 1);
            if (!IN_PICTURE(q)) clear_line(line, stride);
            else EACH_OF_ROW(q) {
                LINKS
                PUT(line + c) = LINED(middle + c)
                    + then * (AT(b + i) + FLOW(LINED, above + c, middle + c, below + c)) * AT(inverse + i);
            }
        }
        for (int q = GREATER(2 * row - 2, top); q < LESSER(2 * row, LESSER(bottom, rows)); ++q) {
            __global float *middle = OTHER_LINE(q), *above = OTHER_LINE(q - 1), *below = OTHER_LINE(q + 1);
            EACH_OF_ROW(q) {
                LINKS
                const reals height = LINED(middle + c)
                    + omega * (AT(b + i) + FLOW(LINED, above + c, middle + c, below + c)) * AT(inverse + i);
                PUT(smoother + i) = height;
                sum += height * AT(b + i);
            }
        }
    }
    parts[get_global_id(0)] = WHOLE(sum);
}

// All passes over the small levels by one item, for each launch would take longer than its pass.

typedef struct {
    int base, rows, stride, first_extra, extras, graph, graphs, restricting, restricts, prolonging, prolongs;
} Level;

#define LEVEL(l) levels[l]
#define TABLE node, start, column, weight
#define EXTRAS_OF(name, l) LEVEL(l).name##ing, LEVEL(l).name##ing + LEVEL(l).name##s
#define GRAPH_OF(l) LEVEL(l).graph, LEVEL(l).graph + LEVEL(l).graphs
#define PICTURE_OF(l) LEVEL(l).base + LEVEL(l).stride, LEVEL(l).base + LEVEL(l).stride * (LEVEL(l).rows + 1)
#define BEHIND(l) LEVEL(l).first_extra, LEVEL(l).first_extra + LEVEL(l).extras
#define GRAPH right, down, anchor
#define ALL_NODES(l) PICTURE_OF(l), LEVEL(l).stride
#define TAIL                                                                                               \
    const int first, const int last, __global const Level *restrict levels, GRAPH_ARGS, \
    MAP inverse, TABLE_ARGS, const int count, __global const int *restrict bottom, MAP matrix, const float omega, \
    const float then

void tail_restrict(const int l, __global const Level *restrict levels, MAP right, MAP down, TABLE_ARGS, MAP residual, OUT b)
{
    const int base = LEVEL(l).base, stride = LEVEL(l).stride;
    const int coarse_base = LEVEL(l + 1).base, coarse_stride = LEVEL(l + 1).stride;
    for (int row = 0; row < LEVEL(l + 1).rows; ++row) {
        RESTRICT_ROW
    }
    restrict_extra(EXTRAS_OF(restrict, l), TABLE, residual, b);
}

void tail_prolong(
    const int l, __global const Level *restrict levels, const float keep, MAP right, MAP down, MAP inverse, TABLE_ARGS,
    MAP e, MAP x, OUT corrected)
{
    const int base = LEVEL(l).base, stride = LEVEL(l).stride;
    const int coarse_base = LEVEL(l + 1).base, coarse_stride = LEVEL(l + 1).stride;
    for (int row = 0; row < LEVEL(l + 1).rows; ++row) {
        PROLONG_ROW
    }
    prolong_extra(EXTRAS_OF(prolong, l), TABLE, keep, inverse, e, x, corrected);
}

void tail_smooth(
    const int l, __global const Level *restrict levels, const float omega, GRAPH_ARGS, MAP inverse, TABLE_ARGS, MAP b,
    MAP x, OUT smoother)
{
    smooth_nodes(ALL_NODES(l), omega, GRAPH, b, x, smoother);
    smooth_extra(GRAPH_OF(l), TABLE, omega, anchor, inverse, b, x, smoother);
}

// A cycle from level `first` on: the answer to b goes to x. Levels from `twice` to `once` are gone through a second time
// for the residual of the first.
#define CYCLE                                                                                              \
    const int twice, const int once, __global float *b, __global float *x, __global float *t, __global float *kept
void tail_cycle(TAIL, CYCLE)
{
    int l = first, second = 0;  // a bit for each level
    do {
        for (; l < last; ++l) {
            begin_nodes(ALL_NODES(l), omega, then, GRAPH, inverse, b, t);
            begin_extra(GRAPH_OF(l), TABLE, omega, then, anchor, inverse, b, t);
            scaled_residual_nodes(ALL_NODES(l), GRAPH, b, t, x);
            residual_extra(GRAPH_OF(l), TABLE, 1, anchor, inverse, b, t, x);
            tail_restrict(l, levels, right, down, TABLE, x, b);
        }
        for (int k = 0; k < count; ++k) solve_node(k, count, bottom, matrix, b, x);
        int again = 0;
        while (l > first && !again) {
            --l;
            tail_prolong(l, levels, 1, right, down, inverse, TABLE, x, t, x);
            tail_smooth(l, levels, then, GRAPH, inverse, TABLE, b, x, t);
            tail_smooth(l, levels, omega, GRAPH, inverse, TABLE, b, t, x);
            if (second >> l & 1) {
                add_nodes(PICTURE_OF(l), kept, x);
                add_nodes(BEHIND(l), kept, x);
            }
            again = l >= twice && l < once && !(second >> l & 1);
            second &= ~(1 << l);
        }
        if (again) {
            residual_nodes(ALL_NODES(l), GRAPH, b, x, t);
            residual_extra(GRAPH_OF(l), TABLE, 0, anchor, inverse, b, x, t);
            keep_nodes(PICTURE_OF(l), t, x, b, kept);
            keep_nodes(BEHIND(l), t, x, b, kept);
            second |= 1 << l;
        }
    } while (l > first || second >> l & 1);
}

__kernel void multigrid_tail_cycle(TAIL, CYCLE)
{
    tail_cycle(first, last, levels, GRAPH, inverse, TABLE, count, bottom, matrix, omega, then, twice, once, b, x, t, kept);
}

// Full multigrid from level `first` on.
__kernel void multigrid_tail_full(TAIL, CYCLE, __global float *full_b, __global float *full_x)
{
    for (int l = first; l < last; ++l) {
        const int base = LEVEL(l).base, stride = LEVEL(l).stride;
        const int coarse_base = LEVEL(l + 1).base, coarse_stride = LEVEL(l + 1).stride;
        for (int row = 0; row < LEVEL(l + 1).rows; ++row)
            gather_row(row, base, stride, coarse_base, coarse_stride, full_b, full_b);
        if (LEVEL(l).restricts == 0) continue;
        scale_nodes(PICTURE_OF(l), inverse, full_b, t);
        scale_nodes(BEHIND(l), inverse, full_b, t);
        tail_restrict(l, levels, right, down, TABLE, t, full_b);
    }
    for (int k = 0; k < count; ++k) solve_node(k, count, bottom, matrix, full_b, x);
    for (int l = last - 1; l >= first; --l) {
        tail_prolong(l, levels, 0, right, down, inverse, TABLE, x, full_b, full_x);
        residual_nodes(ALL_NODES(l), GRAPH, full_b, full_x, b);
        residual_extra(GRAPH_OF(l), TABLE, 0, anchor, inverse, full_b, full_x, b);
        tail_cycle(l, last, levels, GRAPH, inverse, TABLE, count, bottom, matrix, omega, then, twice, once, b, x, t, kept);
        add_nodes(PICTURE_OF(l), full_x, x);
        add_nodes(BEHIND(l), full_x, x);
    }
}
#endif

// Conjugate gradients. Sums are written in parts, for the host to add up.
#define EACH_PART                                                                                          \
    const int begin = base + stride + (int)get_global_id(0) * PART;                                        \
    const int end = LESSER(begin + PART, base + stride * (rows + 1));                                      \
    reals sum = 0;                                                                                         \
    EACH_NODE
#define WRITE_PART if (begin < end) parts[get_global_id(0)] = WHOLE(sum);

// The next direction, the matrix times it, and the product of both.
#define DIRECTION(i) (AT(z + (i)) + beta * AT(before + (i)))
__kernel void multigrid_direct(
    LEVEL_ARGS, const float beta, GRAPH_ARGS, MAP z, MAP before, OUT direction, OUT image, OUT parts)
{
    EACH_PART {
        LINKS
        const reals p = DIRECTION(i), q = -FLOWING(DIRECTION);
        PUT(direction + i) = p;
        PUT(image + i) = q;
        sum += p * q;
    }
    WRITE_PART
}

// A step along it, the residual then, and the square of that.
__kernel void multigrid_advance(LEVEL_ARGS, const float alpha, MAP direction, MAP image, OUT b, OUT x, OUT parts)
{
    EACH_PART {
        const reals r = AT(b + i) - alpha * AT(image + i);
        PUT(x + i) = AT(x + i) + alpha * AT(direction + i);
        PUT(b + i) = r;
        sum += r * r;
    }
    WRITE_PART
}

// Of what a cycle makes of b, z, and of the last step, p, the products with the matrix times them, and of b and p: z A z,
// z A p, p A p and b p.
#define STEP(i) AT(p + (i))
#define CORRECTION(i) AT(z + (i))
__kernel void multigrid_curve(LEVEL_ARGS, GRAPH_ARGS, MAP b, MAP z, MAP p, const int count, OUT parts)
{
    const int begin = base + stride + (int)get_global_id(0) * PART;
    const int end = LESSER(begin + PART, base + stride * (rows + 1));
    reals zz = 0, zp = 0, pp = 0, bp = 0;
    EACH_NODE {
        LINKS
        const reals along = -FLOWING(STEP);
        zz -= CORRECTION(i) * FLOWING(CORRECTION);
        zp += CORRECTION(i) * along;
        pp += STEP(i) * along;
        bp += AT(b + i) * STEP(i);
    }
    if (begin >= end) return;
    __global float *part = parts + get_global_id(0);
    part[0] = WHOLE(zz);
    part[count] = WHOLE(zp);
    part[2 * count] = WHOLE(pp);
    part[3 * count] = WHOLE(bp);
}

// The best step in the plane of both, by the parts of these products and of that of b and z. No sum goes to the host.
#define INDEPENDENT 1e-4f  // share of the products' determinant from which on both directions are used
__kernel void multigrid_follow(
    LEVEL_ARGS, const int products, MAP product, const int count, MAP parts, MAP z, OUT p, OUT x)
{
    ITEMS_NODES
    float bz = 0, zz = 0, zp = 0, pp = 0, bp = 0;
    for (int k = 0; k < products; ++k) bz += product[k];
    for (int k = 0; k < count; ++k) {
        zz += parts[k];
        zp += parts[count + k];
        pp += parts[2 * count + k];
        bp += parts[3 * count + k];
    }
    const float whole = zz * pp, determinant = whole - zp * zp;
    const int both = whole > 0 && determinant > INDEPENDENT * whole;
    const float along = both ? (bz * pp - bp * zp) / determinant : zz > 0 ? bz / zz : 0;
    const float again = both ? (bp * zz - bz * zp) / determinant : 0;
    EACH_NODE {
        const reals step = along * CORRECTION(i) + again * STEP(i);
        PUT(p + i) = step;
        PUT(x + i) = AT(x + i) + step;
    }
}

// The product of two.
__kernel void multigrid_dot(LEVEL_ARGS, MAP one, MAP other, OUT parts)
{
    EACH_PART {
        sum += AT(one + i) * AT(other + i);
    }
    WRITE_PART
}

// What the anchors weigh of heights.
__kernel void multigrid_weigh(LEVEL_ARGS, MAP anchor, MAP x, OUT parts)
{
    EACH_PART {
        sum += AT(anchor + i) * HEIGHT(i) * HEIGHT(i);
    }
    WRITE_PART
}

// Maps of pixels without margins, to and from the finest level, row by row.
__kernel void multigrid_admit(const int rows, const int columns, const int stride, MAP map, OUT level)
{
    const int row = get_global_id(0);
    if (row >= rows) return;
    for (int c = 0; c < columns; ++c) {
        level[(row + 1) * stride + c] = map[row * columns + c];
    }
}

__kernel void multigrid_release(const int rows, const int columns, const int stride, MAP level, OUT map)
{
    const int row = get_global_id(0);
    if (row >= rows) return;
    for (int c = 0; c < columns; ++c) {
        map[row * columns + c] = level[(row + 1) * stride + c];
    }
}

// Standard deviations: the roots of variances, of which each has its least share of one over the diagonal; no number
// where no flag of `wanted` is.
__kernel void multigrid_deviation(
    const int rows, const int columns, const int stride, const float least, const int wanted,
    __global const uchar *restrict flags, MAP inverse, MAP variance, OUT map)
{
    const int row = get_global_id(0);
    if (row >= rows) return;
    for (int c = 0; c < columns; ++c) {
        const int i = (row + 1) * stride + c;
        const float found = GREATER(variance[i], least * inverse[i]);
        map[row * columns + c] = flags[row * columns + c] & wanted ? sqrt(found) : NAN;
    }
}
