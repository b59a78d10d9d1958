#!/usr/bin/env bash
# Lists the licences of all dependencies as Markdown. Needs cargo and jq.
set -euo pipefail
cd "$(dirname "$0")/.."
echo "# Licences of the dependencies"
echo
echo "In all features and on all platforms, the program that makes the book included; made by \`data/licences.sh\`."
echo
echo "| licence | crates |"
echo "| --- | --- |"
cargo metadata --format-version 1 --locked --all-features | jq -r '
  [.packages[] | select(.source)] | group_by(.license // "none given")[] |
  "| \(.[0].license // "none given") | \(map("\(.name) \(.version)") | join(", ")) |"'
