#!/usr/bin/env bash
# tools/page/make.sh: make deworldsg_ros/view/assets/three.min.js from the release of three.js below.
# Needs npm. The result is in the repository, so nobody else needs it.
set -euo pipefail
here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cp "$here/three.js" "$work/entry.js"
cd "$work"
npm init --yes >/dev/null
npm install --no-audit --no-fund three@0.187.0 esbuild@0.28
npx esbuild entry.js --bundle --minify --format=iife --global-name=THREE --legal-comments=none \
  --banner:js="/* three.js 0.187.0, MIT License, (c) 2010-2026 three.js authors */" \
  --outfile="$here/../../deworldsg_ros/view/assets/three.min.js"
