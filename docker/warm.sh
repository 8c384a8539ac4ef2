#!/bin/sh
# Fills the folder "$1" with what would otherwise be compiled when a container runs: every numba kernel that
# an episode calls, and matplotlib's list of fonts.
set -eu
NUMBA_CACHE_DIR=$1/numba
MPLCONFIGDIR=$1/matplotlib
export NUMBA_CACHE_DIR MPLCONFIGDIR
mkdir -p "$NUMBA_CACHE_DIR" "$MPLCONFIGDIR"
# The drive includes every kernel of metrics, geometry, observation and the agent; the worlds differ in shape.
for world in $(cd / && python -c 'import sumo_scenarios; print(*sumo_scenarios.names())'); do
    (cd / && cosim run "$world" --policy vfn-p --behavior mixed --duration 8 --json >/dev/null)
    (cd / && cosim run "$world" --policy altruist-rule --penetration 0.3 --duration 8 --json >/dev/null)
done
(cd / && python -c 'import matplotlib.font_manager')
chmod -R a+rX "$1"
