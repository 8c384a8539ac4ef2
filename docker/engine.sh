# shellcheck shell=bash disable=SC2034
# Sourced by build.sh, smoke.sh and cluster.sh: chooses the container engine and its options.
#
#   ENGINE      docker or podman (default: docker if an engine answers, else podman)
#   IMAGE       the tag to build and to run (default: cosim:ci)
#   BUILD_ARGS  further arguments of the build, RUN_ARGS of every run (split at spaces)

IMAGE=${IMAGE:-cosim:ci}
read -ra build_args <<<"${BUILD_ARGS:-}"
read -ra run_args <<<"${RUN_ARGS:-}"
engine=()

choose_engine() {
    if [ -z "${ENGINE:-}" ]; then
        if command -v docker >/dev/null && docker info >/dev/null 2>&1; then
            ENGINE=docker
        elif command -v podman >/dev/null; then
            ENGINE=podman
        else
            echo "no container engine: neither a running docker nor podman is here." \
                "On Debian: apt-get install buildah podman runc debootstrap" >&2
            exit 2
        fi
    fi
    engine=("$ENGINE")
    [ "$ENGINE" = podman ] || return 0
    # crun does not work with both versions of cgroups mounted; runc does.
    if [ -d /sys/fs/cgroup/unified ] && command -v runc >/dev/null; then
        engine+=(--runtime runc)
    fi
    # podman requests a million open files by default; runc refuses that if the shell's limit is lower.
    run_args=(--ulimit "nofile=1024:$(at_most 4096 "$(ulimit -Hn)")"
        --ulimit "nproc=4096:$(at_most 4096 "$(ulimit -Hu)")" "${run_args[@]}")
}

# at_most LIMIT VALUE: the smaller one, where VALUE may be `unlimited`
at_most() { if [ "$2" = unlimited ] || [ "$2" -gt "$1" ]; then echo "$1"; else echo "$2"; fi; }
