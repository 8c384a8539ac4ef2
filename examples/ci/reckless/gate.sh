#!/bin/sh
# Compares the candidate with the baseline on equal seeds; the exit code says whether it may be merged:
# 0 yes, 1 a threshold failed, 2 bad input, 3 a simulation failed.   gate.sh [FOLDER FOR RESULTS]
set -eu
here=$(cd "$(dirname "$0")" && pwd)
out=${1:-runs/ci-reckless}
again=
if [ -e "$out/store.sqlite" ]; then again=--resume; fi # continue an interrupted job
cosim evaluate "$here/SPEC.yaml" --out "$out" $again
cosim compare "$out" --baseline idm --candidate keep-lane \
    --fail-on 'collision_rate > +5pp' \
    --fail-on 'av_caused_collision_rate > 10%' \
    --junit "$out/junit.xml" --markdown "$out/compare.md"
