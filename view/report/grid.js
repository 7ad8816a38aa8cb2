// The grid of heights: decoding from the page, triangles and slopes, and intersection with a ray.
// Sample k is in row floor(k / columns) and column k % columns. Its piece is 0 in a hole.

function decode(text) {
  const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  return new Uint16Array(bytes.buffer);
}

function readGrid(data) {
  const marks = decode(data.marks);
  const step = (data.highest - data.lowest) / 65535;
  return {
    x: data.x,
    y: data.y,
    z: Float32Array.from(decode(data.heights), (code) => data.lowest + step * code),
    piece: marks.map((mark) => mark & 0x7fff),
    filled: marks.map((mark) => mark >> 15),
  };
}

// Two triangles for each cell whose corners belong to one piece, one if three of them do.
function triangles({ x, y, piece }) {
  const corners = [];
  const add = (a, b, c) => {
    if (piece[a] && piece[a] === piece[b] && piece[b] === piece[c]) corners.push(a, b, c);
  };
  for (let row = 0; row < y.length - 1; row++) {
    for (let column = 0; column < x.length - 1; column++) {
      const a = row * x.length + column, b = a + 1, c = a + x.length, d = c + 1;
      if (piece[b] === piece[c]) {
        add(a, c, b);
        add(b, c, d);
      } else {
        add(a, c, d);
        add(a, d, b);
      }
    }
  }
  return new Uint32Array(corners);
}

// The slope at sample k along a row or column, from the neighbours in the same piece.
function slope({ z, piece }, k, stride, places, index) {
  const before = index > 0 && piece[k - stride] === piece[k] ? 1 : 0;
  const after = index < places.length - 1 && piece[k + stride] === piece[k] ? 1 : 0;
  const run = places[index + after] - places[index - before];
  return run ? (z[k + after * stride] - z[k - before * stride]) / run : 0;
}

// For each sample: x, y, z, dz/dx, dz/dy, and 1 where it was filled.
function vertices(grid) {
  const { x, y, z, filled } = grid;
  const values = new Float32Array(6 * z.length);
  for (let k = 0; k < z.length; k++) {
    const row = Math.floor(k / x.length), column = k % x.length;
    const slopes = [slope(grid, k, 1, x, column), slope(grid, k, x.length, y, row)];
    values.set([x[column], y[row], z[k], ...slopes, filled[k]], 6 * k);
  }
  return values;
}

// The cell that contains a value, and the value's share of the cell; all cells but the last have one size.
function locate(places, value) {
  const guess = Math.floor((value - places[0]) / (places[1] - places[0]));
  const cell = Math.min(Math.max(guess, 0), places.length - 2);
  return [cell, (value - places[cell]) / (places[cell + 1] - places[cell])];
}

// The interpolated height; NaN outside the grid, in a hole and between two pieces.
function heightAt({ x, y, z, piece }, atX, atY) {
  const [column, right] = locate(x, atX);
  const [row, down] = locate(y, atY);
  if (!(right >= 0 && right <= 1 && down >= 0 && down <= 1)) return NaN;
  const a = row * x.length + column, corners = [a, a + 1, a + x.length, a + x.length + 1];
  if (corners.some((k) => !piece[k] || piece[k] !== piece[a])) return NaN;
  const [nw, ne, sw, se] = corners.map((k) => z[k]);
  return (1 - down) * ((1 - right) * nw + right * ne) + down * ((1 - right) * sw + right * se);
}

function isFilledAt({ x, y, filled }, atX, atY) {
  const [[column, right], [row, down]] = [locate(x, atX), locate(y, atY)];
  return filled[(row + Math.round(down)) * x.length + column + Math.round(right)] > 0;
}

// The first intersection of a ray with the surface, or null. The ray runs from the highest height, at 0, to
// the lowest, at 1, so that the vertical exaggeration is not needed.
function meet(grid, [fromX, fromY], [toX, toY], lowest, highest) {
  const cell = Math.min(Math.abs(grid.x[1] - grid.x[0]), Math.abs(grid.y[1] - grid.y[0]));
  const steps = Math.max(1, Math.ceil((2 * Math.hypot(toX - fromX, toY - fromY)) / cell));
  const along = (share) => [fromX + share * (toX - fromX), fromY + share * (toY - fromY)];
  const gap = (share) => highest + share * (lowest - highest) - heightAt(grid, ...along(share));
  let before = gap(0);
  for (let step = 1; step <= steps; step++) {
    const after = gap(step / steps);
    if (before >= 0 && after <= 0) {
      const [x, y] = along((step - 1 + (before - after ? before / (before - after) : 0)) / steps);
      return { x, y, z: heightAt(grid, x, y), filled: isFilledAt(grid, x, y) };
    }
    before = after;
  }
  return null;
}
