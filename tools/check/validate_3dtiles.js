// The checks of validate_3dtiles.sh; see there.
"use strict";
const fs = require("fs");
const path = require("path");
const gltfValidator = require("gltf-validator");
let tilesValidators = null;
try {
  tilesValidators = require("3d-tiles-validator").Validators;
} catch (error) {
  if (error.code !== "MODULE_NOT_FOUND") throw error;
}

const SPLAT_ATTRIBUTE =
  /attributes\/KHR_gaussian_splatting:(ROTATION|SCALE|OPACITY|SH_DEGREE_(0_COEF_0|1_COEF_[0-2]|2_COEF_[0-4]|3_COEF_[0-6]))$/;
const predates = (where, what) =>
  SPLAT_ATTRIBUTE.test(where) && what === "Invalid attribute name.";

async function glbFaults(file) {
  const report = await gltfValidator.validateBytes(new Uint8Array(fs.readFileSync(file)), {
    maxIssues: 0,
  });
  return report.issues.messages
    .filter((m) => m.severity <= 1 && !predates(m.pointer || "", m.message))
    .map((m) => `${m.pointer}: ${m.message}`);
}

// Every issue of the tree that is no heading over others.
function leaves(issues) {
  return issues.flatMap((i) => {
    const causes = i.causes || [];
    return causes.length ? leaves(causes) : [i];
  });
}

async function tilesetFaults(file) {
  if (!tilesValidators) return [];
  const result = await tilesValidators.validateTilesetFile(file);
  return leaves(result.toJson().issues || [])
    .filter((i) => i.severity !== "INFO" && !predates(i.path || "", i.message))
    .map((i) => `${i.path}: ${i.message}`);
}

function contents(tile, folder) {
  const own = [tile.content, ...(tile.contents || [])].filter(Boolean);
  return [
    ...own.map((c) => path.join(folder, c.uri)),
    ...(tile.children || []).flatMap((c) => contents(c, folder)),
  ];
}

async function main(files) {
  let bad = 0;
  for (const file of files) {
    const isTileset = file.endsWith(".json");
    const glbs = isTileset
      ? contents(JSON.parse(fs.readFileSync(file, "utf8")).root, path.dirname(file))
      : [file];
    const faults = isTileset ? await tilesetFaults(file) : [];
    for (const glb of glbs) faults.push(...(await glbFaults(glb)).map((f) => `${glb} ${f}`));
    const by = isTileset && !tilesValidators ? " (3d-tiles-validator not found: content only)" : "";
    console.log(`${faults.length ? "FAIL" : "ok"}   ${file}: ${glbs.length} GLB${by}`);
    faults.slice(0, 20).forEach((f) => console.log(`       ${f}`));
    bad += faults.length;
  }
  process.exit(bad ? 1 : 0);
}

main(process.argv.slice(2));
