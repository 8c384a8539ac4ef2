#!/bin/sh
# Fills the folder "$1" with what would otherwise be compiled when a container runs: every numba kernel that
# an episode calls, and matplotlib's list of fonts.
set -eu
NUMBA_CACHE_DIR=$1/numba
MPLCONFIGDIR=$1/matplotlib
export NUMBA_CACHE_DIR MPLCONFIGDIR
mkdir -p "$NUMBA_CACHE_DIR" "$MPLCONFIGDIR"
cd /  # away from the sources: the kernels of the installed package are meant

quietly() { "$@" >/tmp/warm.log 2>&1 || { cat /tmp/warm.log >&2; exit 1; }; }

# The agent with prediction calls every kernel there is; the worlds differ in what they make it do.
for world in $(python -c 'import sumo_scenarios; print(*sumo_scenarios.names())'); do
    quietly cosim run "$world" --policy vfn-p --behavior mixed --duration 4
    quietly cosim run "$world" --policy altruist-rule --penetration 0.3 --duration 4
done
quietly python -c 'import matplotlib.font_manager'
rm -rf /tmp/warm.log
chmod -R a+rX "$1"
