#!/usr/bin/env bash
# Tests the built image under the restrictions of a CI, from doctor to gate and server: `docker/smoke.sh [RESULTS]`.
#
# No network, read-only root, no capability, no root user. Every exit code is checked. The container's files
# (rows, JUnit, reports, a log) stay in RESULTS (default: runs/smoke, which is emptied first). Variables as in
# engine.sh.
set -euo pipefail
cd "$(dirname "$0")/.."
. docker/engine.sh
choose_engine

results=$(realpath -m "${1:-runs/smoke}")
if [ -e "$results" ] && [ -n "$(ls -A "$results")" ] && [ ! -e "$results/smoke.log" ]; then
    echo "$results is not empty and not from an earlier smoke test: name another folder" >&2
    exit 2
fi
rm -rf "$results"
mkdir -p "$results"
mounted=$(mktemp -d)
trap 'rm -rf "$mounted"' EXIT
cp -R docker/smoke/. "$mounted"
cp sumo_scenarios/merge/net.net.xml "$mounted/mine.net.xml"
chmod -R a+rX "$mounted"

# The results belong to the user who runs this script, but never to root.
if [ "$(id -u)" = 0 ]; then
    user=(--user 10001:10001)
    chown 10001:10001 "$results"
else
    user=(--user "$(id -u):$(id -g)")
    if [ "$ENGINE" = podman ]; then user+=(--userns keep-id); fi
fi
locked=(--rm --network none --read-only --tmpfs /tmp:size=512m --cap-drop ALL --security-opt no-new-privileges
    --memory 2g --pids-limit 256 "${user[@]}"
    --volume "$mounted:/scenarios:ro" --volume "$results:/results")

checks=0 failed=0
log=$results/smoke.log

# expect CODE NAME [ENGINE ARGUMENT... --] ARGUMENT...: one container; its stdout lands in $out
out=$mounted/out
expect() {
    local wanted=$1 name=$2 own=() began code=0
    shift 2
    if [[ " $* " == *" -- "* ]]; then
        while [ "$1" != -- ]; do own+=("$1"); shift; done
        shift
    fi
    began=$(date +%s%N)
    "${engine[@]}" run "${locked[@]}" "${run_args[@]}" "${own[@]}" "$IMAGE" "$@" >"$out" 2>"$mounted/err" || code=$?
    checks=$((checks + 1))
    local state=ok
    [ "$code" = "$wanted" ] || { state=FAIL; failed=$((failed + 1)); }
    printf '%-4s %6.1f s  exit %s  %s\n' "$state" "$((($(date +%s%N) - began) / 100000000))e-1" "$code" "$name" |
        tee -a "$log"
    { echo "\$ $*"; cat "$out" "$mounted/err"; echo; } >>"$log"
    if [ "$state" = FAIL ]; then
        echo "     wanted exit code $wanted:"
        cat "$out" "$mounted/err" | tail -n 15 | sed 's/^/     /'
    fi
}

all_began=$SECONDS
echo "== $IMAGE with $ENGINE" | tee "$log"
expect 0 "locked up, seen from inside" --entrypoint python -- /scenarios/isolation.py
expect 0 "doctor" doctor
expect 0 "run a shipped scenario" run merge --demand contested --json
cp "$out" "$results/run.json"
expect 0 "run on a processor that the caches were not compiled for" \
    --env NUMBA_CPU_NAME=generic --env NUMBA_CPU_FEATURES= -- run merge --duration 2 --json
expect 0 "evaluate a shipped scenario" evaluate --scenario merge --demand contested \
    --policy idm --policy keep-lane --policy altruist-rule --seeds 200000:200003 --workers 2 --out /results/builtin
expect 0 "evaluate a mounted .sumocfg with mounted demand" evaluate --scenario /scenarios/mine.sumocfg \
    --demand '/scenarios/demand/*.rou.xml' --demand '/scenarios/demand/*.trips.xml' --penetration 0.3 \
    --policy idm --policy altruist-rule --seeds 200000:200002 --duration 20 --workers 2 --out /results/mine
expect 0 "resume a complete run" evaluate --scenario merge --demand contested \
    --policy idm --policy keep-lane --policy altruist-rule --seeds 200000:200003 --resume --out /results/builtin
expect 0 "gate: a better policy passes" compare /results/builtin --baseline keep-lane --candidate altruist-rule \
    --across preset --fail-on 'collision_rate > +0.5pp' --junit /results/gate-pass.xml --markdown /results/gate-pass.md
expect 1 "gate: a worse policy fails" compare /results/builtin --baseline altruist-rule --candidate keep-lane \
    --across preset --fail-on 'collision_rate > +0.5pp' --junit /results/gate-fail.xml --markdown /results/gate-fail.md
expect 2 "gate: an unknown metric is bad input" compare /results/builtin --baseline idm --candidate keep-lane \
    --across preset --fail-on 'colision_rate > 1pp'
expect 2 "a missing demand is bad input" evaluate --scenario /scenarios/mine.sumocfg \
    --demand '/scenarios/demand/none*.xml' --out /results/none
expect 0 "report of the shipped scenario" report /results/builtin
expect 0 "report of the mounted scenario" report /results/mine
expect 0 "serve: a scenario, an upload, a kill in between, a replay, a session" --entrypoint tini -- -- \
    with-caches python /scenarios/serving.py
expect 0 "rows, JUnit and reports are readable" --entrypoint python -- /scenarios/artefacts.py

fits="yes"
"${engine[@]}" run "${locked[@]}" "${run_args[@]}" --entrypoint with-caches "$IMAGE" sh -c \
    'cosim run merge --demand contested --policy vfn-p --duration 4 --json >/dev/null 2>&1
     diff -rq /opt/cosim/caches/numba /tmp/cosim-caches/numba' >>"$log" 2>&1 ||
    fits="no: compiled in every container (another processor, or a kernel that warm.sh does not call)"
echo "     the image's compiled kernels fit this processor: $fits" | tee -a "$log"

verdict="passed"
[ "$failed" = 0 ] || verdict="FAILED"
echo "== smoke $verdict: $((checks - failed)) of $checks checks, $((SECONDS - all_began)) s; results in $results" |
    tee -a "$log"
[ "$failed" = 0 ]
