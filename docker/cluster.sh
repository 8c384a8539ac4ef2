#!/usr/bin/env bash
# Tests a Ray cluster of two machines as two containers: `docker/cluster.sh [RESULTS]`.
#
# A head and a worker on their own network, with a token; the worker is killed during the run. Passes if every
# episode was driven with the same trace hash as with the local engine. Needs an image with Ray:
# EXTRAS=ray IMAGE=cosim:ray docker/build.sh. The same commands on separate machines make a real cluster
# (docs/guides/container.md). Variables as in engine.sh.
set -euo pipefail
cd "$(dirname "$0")/.."
IMAGE=${IMAGE:-cosim:ray}
. docker/engine.sh
choose_engine

results=$(realpath -m "${1:-runs/cluster}")
mkdir -p "$results"
[ -z "$(ls -A "$results")" ] || { echo "$results is not empty" >&2; exit 2; }
[ "$(id -u)" != 0 ] || chown 10001:10001 "$results"
name=cosim-cluster-$$
token=$(mktemp)
head -c 32 /dev/urandom | od -An -tx1 | tr -d ' \n' >"$token"
chmod 0444 "$token"
clean() {
    "${engine[@]}" rm -f "$name-head" "$name-worker" >/dev/null 2>&1 || true
    "${engine[@]}" network rm "$name" >/dev/null 2>&1 || true
    rm -f "$token"
}
trap clean EXIT
"${engine[@]}" network create "$name" >/dev/null

# Options of every node: a lost connection is noticed after 15 s instead of two minutes.
node_options=(--env RAY_AUTH_MODE=token --env RAY_AUTH_TOKEN_PATH=/run/ray-token --volume "$token:/run/ray-token:ro"
    --env RAY_grpc_client_keepalive_time_ms=2000 --env RAY_grpc_client_keepalive_timeout_ms=2000
    --env RAY_grpc_keepalive_time_ms=2000 --env RAY_grpc_keepalive_timeout_ms=2000
    --env RAY_USAGE_STATS_ENABLED=0)
locked=(--network "$name" --read-only --tmpfs /tmp:size=1g --shm-size 512m --cap-drop ALL
    --security-opt no-new-privileges --memory 4g --pids-limit 2048)
node() { # node NAME RAY ARGUMENTS...
    local own=$1
    shift
    "${engine[@]}" run --detach --name "$name-$own" "${locked[@]}" "${node_options[@]}" "${run_args[@]}" \
        --volume "$results:/results" --entrypoint tini "$IMAGE" -- with-caches ray start --block \
        --num-cpus 1 --object-store-memory 200000000 "$@" >/dev/null
}
in_head() { "${engine[@]}" exec "$name-head" "$@"; }

node head --head --port 6379 --include-dashboard false
address=$("${engine[@]}" inspect --format '{{range .NetworkSettings.Networks}}{{.IPAddress}}{{end}}' "$name-head"):6379
node worker --address "$address"
echo "== two nodes at $address"
for _ in $(seq 90); do
    in_head ray status 2>/dev/null | grep -q '/2.0 CPU' && break
    sleep 1
done
in_head ray status | grep -q '/2.0 CPU' ||
    { echo "the worker never joined"; "${engine[@]}" logs "$name-worker" | tail -n 20; exit 1; }

matrix=(--scenario merge --demand contested --policy idm --policy altruist-rule --seeds 200000:200006)
in_head cosim evaluate "${matrix[@]}" --engine ray --ray-address "$address" --out /results/ray \
    2>"$results/ray.log" &
driver=$!
killed=no
while kill -0 "$driver" 2>/dev/null; do
    if [ "$killed" = no ] && grep -qE '[^0-9][1-9][0-9]*/12 ' "$results/ray.log"; then
        "${engine[@]}" kill --signal KILL "$name-worker" >/dev/null
        killed=yes
        echo "== worker killed after: $(tr '\r' '\n' <"$results/ray.log" | tail -n 1)"
    fi
    sleep 0.2
done
wait "$driver" || { echo "the driver failed"; tail -n 20 "$results/ray.log"; exit 1; }
[ "$killed" = yes ] || { echo "the run ended before the worker was killed"; exit 1; }
in_head cosim evaluate "${matrix[@]}" --workers 2 --out /results/local 2>/dev/null
in_head python -c '
import pyarrow.parquet as parquet
ray, local = ({r["key"]: (r["status"], r["trace_hash"]) for r in parquet.read_table(f"/results/{n}/episodes.parquet")
              .to_pylist()} for n in ("ray", "local"))
assert len(ray) == 12 and ray == local, (ray, local)
print(f"== cluster passed: {len(ray)} episodes, one node lost, every trace hash as with the local engine")'
