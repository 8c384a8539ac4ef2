#!/bin/sh
# Evaluates the candidate beside the baseline on equal seeds and says by its exit code whether it may be merged:
# 0 yes, 1 a threshold failed, 2 bad input, 3 a simulation failed.   gate.sh [FOLDER FOR RESULTS]
set -eu
here=$(cd "$(dirname "$0")" && pwd)
out=${1:-runs/ci-reckless}
again=
if [ -e "$out/store.sqlite" ]; then again=--resume; fi # a job that was cut off goes on where it was
cosim evaluate "$here/SPEC.yaml" --out "$out" $again
cosim compare "$out" --baseline idm --candidate keep-lane \
    --fail-on 'collision_rate > +5pp' \
    --fail-on 'av_caused_collision_rate > 10%' \
    --junit "$out/junit.xml" --markdown "$out/compare.md"
