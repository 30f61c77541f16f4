#!/usr/bin/env bash
# Check GLB files and 3D Tiles tilesets with the validators their makers publish on npm.
#
#   tools/check/validate_3dtiles.sh [--no-install] FILE.glb|TILESET.json ...
#
# Needs node >= 18. Packages (gltf-validator by Khronos, and 3d-tiles-validator by Cesium where npm has it) are looked for
# in NPM_VALIDATORS (default: ~/.cache/gsmap/validators) and installed there unless --no-install is given.
# Exit: 0 no faults, 1 faults, 3 the validators are not there.
#
# gltf-validator up to 2.0.0-dev.3.10 predates extensions that name attributes "EXTENSION:NAME" and calls each of them an
# invalid attribute name. Exactly those messages, for exactly the attributes of KHR_gaussian_splatting, are left out.
set -eu
here=$(cd "$(dirname "$0")" && pwd)
folder=${NPM_VALIDATORS:-$HOME/.cache/gsmap/validators}
install=1
if [ "${1:-}" = "--no-install" ]; then install=0; shift; fi
command -v node >/dev/null || { echo "node is not installed" >&2; exit 3; }
if [ ! -d "$folder/node_modules/gltf-validator" ]; then
    [ $install = 1 ] || { echo "gltf-validator is not in $folder: run tools/check/validate_3dtiles.sh once" >&2; exit 3; }
    mkdir -p "$folder"
    npm install --silent --no-audit --no-fund --prefix "$folder" gltf-validator >&2
    npm install --silent --no-audit --no-fund --prefix "$folder" 3d-tiles-validator >&2 ||
        echo "3d-tiles-validator could not be installed: only the content is checked by a published validator" >&2
fi
NODE_PATH="$folder/node_modules" exec node "$here/validate_3dtiles.js" "$@"
