#!/bin/sh
# Debian's mosquitto, PostgreSQL, Chromium, Prometheus (for promtool) and docker-compose, which some tests start for
# themselves; without root or apt-get those tests are skipped.
set -eu

POLICY=/usr/sbin/policy-rc.d

have_mosquitto() { command -v mosquitto >/dev/null || [ -x /usr/sbin/mosquitto ]; }
have_postgresql() { command -v initdb >/dev/null || ls /usr/lib/postgresql/*/bin/initdb >/dev/null 2>&1; }

have_chromium() { command -v chromium >/dev/null; }

missing=""
have_mosquitto || missing="$missing mosquitto"
have_postgresql || missing="$missing postgresql"
have_chromium || missing="$missing chromium"
command -v promtool >/dev/null || missing="$missing prometheus"
command -v docker-compose >/dev/null || missing="$missing docker-compose"
[ -n "$missing" ] || exit 0

go_on() {
    echo "tests that need$missing will be skipped: $1"
    exit 0
}

[ "${PACKAGES:-yes}" = yes ] || go_on "PACKAGES=${PACKAGES}."
[ "$(id -u)" = 0 ] || go_on "installing it takes root (apt-get install$missing)."
command -v apt-get >/dev/null || go_on "it is not installed and there is no apt-get."

said=$(mktemp)
trap 'rm -f "$said"' EXIT

# Tests start servers of their own: what is installed must not start any, nor must what is there already be told otherwise.
if [ ! -e "$POLICY" ]; then
    trap 'rm -f "$POLICY" "$said"' EXIT
    printf '#!/bin/sh\nexit 101\n' >"$POLICY"
    chmod 755 "$POLICY"
fi

export DEBIAN_FRONTEND=noninteractive
apt() { apt-get -qq -o DPkg::Lock::Timeout=300 -o Dpkg::Use-Pty=0 "$@" >"$said" 2>&1 || { cat "$said" >&2 && false; }; }

echo "installing Debian packages that some tests need (once):$missing"
echo "(make test PACKAGES=no leaves the system as it is and skips those tests)"
apt update || echo "apt-get update failed; trying with what is known"
# shellcheck disable=SC2086  # one word each
apt install --yes --no-install-recommends $missing || {
    [ -n "${CI:-}" ] && echo "apt-get could not install$missing" >&2 && exit 1
    go_on "apt-get could not install it."
}
