#!/bin/sh
# Fills the folder "$1" with the caches that a container would otherwise have to make: compiled numba kernels of
# an episode, and matplotlib's list of fonts.
set -eu
NUMBA_CACHE_DIR=$1/numba
MPLCONFIGDIR=$1/matplotlib
export NUMBA_CACHE_DIR MPLCONFIGDIR
mkdir -p "$NUMBA_CACHE_DIR" "$MPLCONFIGDIR"
cd /  # so that the installed package is imported, not the sources

quietly() { "$@" >/tmp/warm.log 2>&1 || { cat /tmp/warm.log >&2; exit 1; }; }

# The agent with prediction calls every kernel; a second scenario has other shapes.
quietly cosim run merge --policy vfn-p --behavior mixed --duration 4
quietly cosim run intersection --policy vfn-p --demand dense --duration 4
quietly python -c 'import matplotlib.font_manager'
rm -rf /tmp/warm.log
chmod -R a+rX "$1"
