// Orders splats from far to near, off the page's own thread.
"use strict";

const BUCKETS = 65536;
const counts = new Uint32Array(BUCKETS + 1);
let positions = new Float32Array(0); // x y z of every splat
let scenes = new Uint16Array(0); // which scene it is of; 65535 is padding

onmessage = ({ data }) => {
  if (data.positions) {
    positions = data.positions;
    scenes = data.scenes;
    return;
  }
  postMessage(order(data.forward, data.visible), undefined);
};

// Indices of the visible splats by depth along `forward`, farthest first: a counting sort over 65536 depths.
function order(forward, visible) {
  const n = scenes.length;
  const depths = new Float32Array(n);
  let near = Infinity;
  let far = -Infinity;
  let shown = 0;
  for (let i = 0; i < n; i++) {
    if (!visible[scenes[i]]) continue;
    const p = 3 * i;
    const depth = forward[0] * positions[p] + forward[1] * positions[p + 1] + forward[2] * positions[p + 2];
    depths[i] = depth;
    if (depth < near) near = depth;
    if (depth > far) far = depth;
    shown++;
  }
  const scale = far > near ? (BUCKETS - 1) / (far - near) : 0;
  counts.fill(0);
  for (let i = 0; i < n; i++) if (visible[scenes[i]]) counts[1 + (((far - depths[i]) * scale) | 0)]++;
  for (let b = 0; b < BUCKETS; b++) counts[b + 1] += counts[b];
  const out = new Uint32Array(shown);
  for (let i = 0; i < n; i++) if (visible[scenes[i]]) out[counts[((far - depths[i]) * scale) | 0]++] = i;
  return out;
}
