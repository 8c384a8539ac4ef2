#!/bin/sh
# Gives a container its own writable copy of the caches that were compiled into the image, then runs "$@".
#
# numba does not read a cache it cannot write, and a read-only root has none: so the copy lies in /tmp. What was
# compiled for another processor is passed over there and compiled anew, once in a container's life.
set -eu
caches=/tmp/cosim-caches
if [ -d /opt/cosim/caches ] && [ ! -d "$caches" ]; then
    # Under another name first: a second process that starts meanwhile never sees half of it.
    if ! cp -R /opt/cosim/caches "$caches.$$" 2>/dev/null; then
        echo "cosim: cannot write /tmp: run the container with --tmpfs /tmp" >&2
        exit 2
    fi
    mv -T "$caches.$$" "$caches" 2>/dev/null || rm -rf "$caches.$$"
fi
exec "$@"
