// The choice of tiles, by standard input and output, for tests against a plain one.
import { choose, drawable } from "../../../gsmap/view/page/src/stage/lod";

interface Node {
  id: number;
  count: number;
  error: number; // px; negative: not in sight
  ready: boolean;
  finer: Node[] | null;
}
let text = "";
for await (const part of process.stdin) text += part;
const cases = JSON.parse(text) as { roots: Node[]; budget: number; least: number }[];
const out = cases.map(({ roots, budget, least }) => {
  const cut = choose(roots, (node) => node.error, budget, least);
  const drawn = drawable(
    roots,
    cut,
    (node) => node.error >= 0,
    (node) => node.ready,
  );
  return {
    tiles: cut.tiles.map((node) => node.id).sort((a, b) => a - b),
    unknown: cut.unknown.map((node) => node.id).sort((a, b) => a - b),
    splats: cut.splats,
    drawn: drawn.map((node) => node.id).sort((a, b) => a - b),
  };
});
console.log(JSON.stringify(out));
