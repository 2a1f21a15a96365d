#!/usr/bin/env bash
# Runs a command in the environment of scripts/demo: entrypoint.sh COMMAND ...
# The first call makes the environment; the Dockerfiles do that.
if [ -f /opt/ros/jazzy/setup.bash ]; then
  # shellcheck source=/dev/null
  . /opt/ros/jazzy/setup.bash
fi
set -euo pipefail
# shellcheck source=scripts/bootstrap.sh
. "$(dirname "${BASH_SOURCE[0]}")/../scripts/bootstrap.sh"
bootstrap run
exec "$@"
