#!/bin/sh
# Compares the candidate with the baseline on equal seeds; the exit code says whether it may be merged:
# 0 yes, 1 a threshold failed, 2 bad input, 3 a simulation failed.   gate.sh [FOLDER FOR RESULTS]
set -eu
here=$(cd "$(dirname "$0")" && pwd)
out=${1:-runs/ci-altruist}
again=
if [ -e "$out/store.sqlite" ]; then again=--resume; fi # continue an interrupted job
cosim evaluate "$here/SPEC.yaml" --out "$out" $again
cosim compare "$out" --baseline idm --candidate altruist-rule \
    --fail-on 'collision_rate > +0pp' \
    --fail-on 'mission_success_rate < +30pp' \
    --fail-on 'dt_av_m < -20%' \
    --junit "$out/junit.xml" --markdown "$out/compare.md"
