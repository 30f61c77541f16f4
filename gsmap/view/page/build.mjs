// Bundles the page into ../built (or the folder named): one script, one style sheet, one page, and the licences of
// what is in the bundle. `npm ci && npm run build`; tools/build_page.sh does both.
import { cpSync, mkdirSync, readFileSync, rmSync, writeFileSync } from "node:fs";
import { join } from "node:path";
import { build } from "esbuild";

const out = process.argv[2] ?? join(import.meta.dirname, "..", "built");
rmSync(out, { recursive: true, force: true });
mkdirSync(out, { recursive: true });
const result = await build({
  entryPoints: { page: join(import.meta.dirname, "src", "main.ts") },
  outdir: out,
  bundle: true,
  minify: true,
  format: "esm",
  target: "es2022",
  legalComments: "none",
  metafile: true,
  loader: { ".wasm": "file" },
  logLevel: "warning",
});
for (const name of ["index.html", "style.css"]) cpSync(join(import.meta.dirname, name), join(out, name));

const packages = new Set();
for (const path of Object.keys(result.metafile.inputs)) {
  const found = path.match(/node_modules\/((?:@[^/]+\/)?[^/]+)\//);
  if (found) packages.add(found[1]);
}
const texts = [...packages].sort().map((name) => {
  const folder = join(import.meta.dirname, "node_modules", name);
  const { version, license } = JSON.parse(readFileSync(join(folder, "package.json"), "utf8"));
  let text = "";
  for (const file of ["LICENSE", "LICENSE.md", "LICENSE.txt", "license"]) {
    try {
      text = readFileSync(join(folder, file), "utf8");
      break;
    } catch {}
  }
  return `${name} ${version} (${license})\n\n${text.trim()}\n`;
});
writeFileSync(join(out, "LICENCES.txt"), texts.join(`\n${"-".repeat(100)}\n\n`));
