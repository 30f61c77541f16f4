// Bundles the page with the 3D view of the tests in place of its own: node build.mjs OUT
import { cpSync, mkdirSync } from "node:fs";
import { createRequire } from "node:module";
import { join } from "node:path";

const page = join(import.meta.dirname, "..", "..", "..", "gsmap", "view", "page");
const { build } = createRequire(join(page, "package.json"))("esbuild");
const out = process.argv[2];
mkdirSync(out, { recursive: true });
await build({
  entryPoints: { page: join(page, "src", "main.ts") },
  outdir: out,
  bundle: true,
  format: "esm",
  target: "es2022",
  tsconfig: join(page, "tsconfig.json"),
  logLevel: "warning",
  plugins: [
    {
      name: "fake stage",
      setup: (one) =>
        one.onResolve({ filter: /\/view3d$/ }, () => ({ path: join(import.meta.dirname, "fake_stage.ts") })),
    },
  ],
});
for (const name of ["index.html", "style.css"]) cpSync(join(page, name), join(out, name));
