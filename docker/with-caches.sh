#!/bin/sh
# Gives a container its own writable copy of the image's caches, then runs "$@".
#
# numba reads only a writable cache, and the root may be read-only: so the copy is in /tmp. Kernels for another
# processor are compiled again there, once per container.
set -eu
caches=/tmp/cosim-caches
if [ -d /opt/cosim/caches ] && [ ! -d "$caches" ]; then
    # Under another name first, so that a concurrent process never sees a part of the copy.
    if ! cp -R /opt/cosim/caches "$caches.$$" 2>/dev/null; then
        echo "cosim: cannot write /tmp: run the container with --tmpfs /tmp" >&2
        exit 2
    fi
    mv -T "$caches.$$" "$caches" 2>/dev/null || rm -rf "$caches.$$"
fi
exec "$@"
