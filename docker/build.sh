#!/usr/bin/env bash
# Builds the image, with a Docker engine or without: `docker/build.sh [runtime|test]`.
#
# Without an engine, buildah builds on a Debian from debootstrap (made once and kept in the local store). The
# build uses this machine's pip settings: pip's files and variables (PIP_CONFIG_FILE, PIP_FIND_LINKS,
# PIP_CERT, ...), and the folders in them, which are mounted. Variables, besides those of engine.sh:
#
#   BASE     the image to start from (default: debian:bookworm-slim, or made by debootstrap)
#   EXTRAS   extras of pyproject.toml to put in, with commas between (default: service,postgresql)
#   PIP_INDEX_URL, PIP_EXTRA_INDEX_URL   the only pip settings for a Docker engine, which mounts nothing
set -euo pipefail
cd "$(dirname "$0")/.."
. docker/engine.sh
target=${1:-runtime}
case $target in
    runtime | test) ;;
    *) sed -n '2,/^set/{s/^# \{0,1\}//p}' "$0"; exit 2 ;;
esac
choose_engine
tag=$IMAGE
[ "$target" = runtime ] || tag=$IMAGE-$target
local_base=localhost/debian-base:bookworm
args=(--file docker/Dockerfile --target "$target" --tag "$tag"
    --build-arg "EXTRAS=${EXTRAS-service,postgresql}"
    --build-arg "REVISION=$(git describe --always --dirty --abbrev=40 --exclude '*' 2>/dev/null || echo unknown)")

make_base() {
    local root
    root=$(mktemp -d)
    echo "== $local_base: debootstrap"
    debootstrap --variant=minbase --include=ca-certificates bookworm "$root" >"$root.log" 2>&1 ||
        { tail -n 20 "$root.log" >&2; exit 4; }
    rm -rf "$root"/var/cache/apt/archives/*.deb "$root"/var/cache/apt/*.bin "$root"/var/lib/apt/lists/* \
        "$root"/var/log/* "$root"/etc/resolv.conf "$root"/etc/hostname "$root.log"
    tar -C "$root" --one-file-system -c . | podman import --quiet - "$local_base" >/dev/null
    rm -rf "$root"
}

began=$SECONDS
if [ "$ENGINE" = docker ]; then
    [ -z "${BASE:-}" ] || args+=(--build-arg "BASE=$BASE")
    for name in PIP_INDEX_URL PIP_EXTRA_INDEX_URL; do
        [ -z "${!name:-}" ] || args+=(--build-arg "$name=${!name}")
    done
    docker build "${args[@]}" "${build_args[@]}" .
else
    if [ -z "${BASE:-}" ] && [ "$(id -u)" = 0 ] && command -v debootstrap >/dev/null; then
        podman image exists "$local_base" || make_base
        BASE=$local_base
    fi
    [ -z "${BASE:-}" ] || args+=(--build-arg "BASE=$BASE")
    lent=$(mktemp -d)
    trap 'rm -rf "$lent"' EXIT
    python3 docker/host_pip.py "$lent" >"$lent/mounts"
    while read -r source inside; do args+=(--volume "$source:$inside:ro"); done <"$lent/mounts"
    args+=(--volume "$lent:/run/host-pip:ro" --build-arg PIP_CONFIG_FILE=/run/host-pip/pip.conf)
    # chroot: without a runtime or own namespaces, so that the build also works inside a container.
    buildah bud --isolation chroot --network host --layers "${args[@]}" "${build_args[@]}" .
fi
size=$("${engine[@]}" image inspect --format '{{.Size}}' "$tag")
echo "== $tag: $((size / 1000000)) MB, built in $((SECONDS - began)) s"
