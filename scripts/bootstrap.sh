# shellcheck shell=bash
# The environment of scripts/demo and scripts/test. Source it, then call `bootstrap run` or
# `bootstrap test`. Afterwards .venv holds the requirements of pyproject.toml and the project
# itself, PATH begins with .venv/bin, and the ROS variables are set. Nothing outside the checkout
# changes, except pip's cache.
#
# Each slow step stores the hash of its input in .venv/.bootstrap. A start without changes does no
# work; an interrupted start continues where it stopped.

root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
venv="$root/.venv"
stamps="$venv/.bootstrap"
log="$stamps/log.txt"

say() { printf '%s\n' "$*" >&2; }

fail() {
  printf '%s: %s\n' "${0##*/}" "$*" >&2
  exit 1
}

# quietly LABEL COMMAND...: run with one line on the terminal; the output is shown if it fails.
quietly() {
  local label=$1 began=$SECONDS pid status=0 turn=0
  shift
  "$@" >"$log" 2>&1 </dev/null 9>&- &
  pid=$!
  trap 'kill "$pid" 2>/dev/null; say; fail "stopped; the next start continues from here"' INT TERM
  if [ -t 2 ]; then
    while kill -0 "$pid" 2>/dev/null; do
      printf '\r  %s %s … %d s ' "$(printf '%s' '|/-\' | cut -c $((turn % 4 + 1)))" "$label" \
        $((SECONDS - began)) >&2
      turn=$((turn + 1))
      sleep 0.3
    done
    printf '\r\033[K' >&2
  else
    say "  $label …"
  fi
  wait "$pid" || status=$?
  trap - INT TERM
  if [ "$status" -ne 0 ]; then
    tail -n 40 "$log" >&2
    fail "$label failed with status $status; the whole output is in ${log#"$root"/}"
  fi
  say "  $label: done in $((SECONDS - began)) s"
}

# True if ROS 2 Jazzy is sourced in this shell and its python3 can import rclpy.
jazzy_is_sourced() {
  [ "${ROS_DISTRO:-}" = jazzy ] && python3 -c 'import rclpy' 2>/dev/null
}

# Remove the variables that another ROS or another environment set in this shell.
forget_other_ros() {
  if [ -n "${ROS_DISTRO:-}" ]; then
    say "  ROS 2 ${ROS_DISTRO} is sourced but not usable here (expected: jazzy, with rclpy for" \
      "python3); using the project's own ROS 2 Jazzy instead"
  fi
  # The wheels re-execute each interpreter once to set LD_LIBRARY_PATH; inherited from another
  # environment, their guard would leave the variable pointing there.
  if [ -n "${ROS_DISTRO:-}${_ROS_WHEELS_BOOTSTRAP_COMPLETE:-}" ]; then unset LD_LIBRARY_PATH; fi
  unset _ROS_WHEELS_BOOTSTRAP_COMPLETE ROS_DISTRO ROS_VERSION ROS_PYTHON_VERSION \
    AMENT_PREFIX_PATH COLCON_PREFIX_PATH CMAKE_PREFIX_PATH PYTHONPATH
  export RMW_IMPLEMENTATION=rmw_fastrtps_cpp
}

version_of() { "$1" -I -S -c 'import sys; print("%d.%d" % sys.version_info[:2])' 2>/dev/null; }

# Print a Python 3.10-3.13 that can make virtual environments.
find_python() {
  local candidate version seen=""
  for candidate in ${PYTHON:-} python3 python3.13 python3.12 python3.11 python3.10; do
    version=$(version_of "$candidate") || continue
    case $version in
      3.10 | 3.11 | 3.12 | 3.13)
        if "$candidate" -I -c 'import ensurepip, venv' 2>/dev/null; then
          "$candidate" -I -c 'import sys; print(sys.executable)'
          return
        fi
        seen="$seen, $candidate is $version but has no venv (Debian, Ubuntu: apt install python$version-venv)"
        ;;
      *) seen="$seen, $candidate is $version" ;;
    esac
  done
  seen=${seen:-, none}
  fail "needs Python 3.10, 3.11, 3.12 or 3.13 with venv on PATH (or in \$PYTHON); found: ${seen#, }"
}

hash_of() { (cd "$root" && find "$@" -type f ! -name '*.py[cod]' ! -name '*.nb[ic]' -print0) |
  LC_ALL=C sort -z | (cd "$root" && xargs -0 sha256sum) | sha256sum | cut -d ' ' -f 1; }

is_current() { [ "$(cat "$stamps/$1" 2>/dev/null)" = "$2" ]; }

# Make .venv. Make it again if the folder, the Python or the ROS has changed.
make_venv() {
  local ros=$1 python=${PYTHON:-"$venv/bin/python"} options=()
  is_current venv "$root $ros $(version_of "$python")" && return
  if [ "$ros" = sourced ]; then
    python=$(command -v python3)
    options=(--system-site-packages)
  else
    python=$(find_python) || exit 1
  fi
  find "$venv" -mindepth 1 -maxdepth 1 ! -name .bootstrap -exec rm -rf {} +
  rm -f "$stamps"/{venv,run,test,project}
  quietly "making .venv with $python" "$python" -m venv ${options[@]+"${options[@]}"} "$venv"
  echo "$root $ros $(version_of "$venv/bin/python")" >"$stamps/venv"
}

pip_install() { "$venv/bin/python" -m pip install --no-input --prefer-binary \
  --disable-pip-version-check "$@"; }

# Install the requirements of a profile (run or test) from pyproject.toml. With
# DEWORLDSG_TEST_MODELS set, test includes torch and transformers. A sourced ROS needs no ROS
# wheels, but the numpy generation that its message types were compiled against.
install_requirements() {
  local ros=$1 profile=$2 extras=(build run) arguments=() list expected
  [ "$ros" = sourced ] || extras+=(ros)
  [ "$profile" = run ] || extras+=(test)
  if [ "$profile" = test ] && [ -n "${DEWORLDSG_TEST_MODELS:-}" ]; then
    extras+=(test-models)
  fi
  list=$("$venv/bin/python" "$root/scripts/requirements.py" "${extras[@]}") ||
    fail "scripts/requirements.py cannot read pyproject.toml"
  expected=$(sha256sum <<<"$list" | cut -d ' ' -f 1)
  is_current "$profile" "$expected" && return
  echo "$list" >"$stamps/requirements.txt"
  arguments+=(-r "$stamps/requirements.txt")
  if [ "$ros" = sourced ] && python3 -c 'import numpy, sys; sys.exit(numpy.__version__[0] != "1")' 2>/dev/null; then
    echo 'numpy<2' >"$stamps/constraints.txt"
    arguments+=(-c "$stamps/constraints.txt")
  fi
  rm -f "$stamps/$profile"
  quietly "installing the requirements (${extras[*]})" pip_install "${arguments[@]}"
  echo "$expected" >"$stamps/$profile"
}

# Install the project from a clean copy, so that no build/ is left in the checkout and no module
# deleted since the last build comes back.
install_project() {
  local name expected sources=()
  for name in package.xml setup.py setup.cfg pyproject.toml README.md LICENSE \
    deworldsg_ros resource launch config msg_schemas bags scripts/ros; do
    [ ! -e "$root/$name" ] || sources+=("$name")
  done
  expected=$(hash_of "${sources[@]}")
  is_current project "$expected" && [ -x "$venv/bin/deworldsg" ] && return
  rm -rf "$stamps/source" "$stamps/project"
  mkdir "$stamps/source"
  (cd "$root" && cp -r --parents "${sources[@]}" "$stamps/source")
  find "$stamps/source" -name __pycache__ -exec rm -rf {} +
  quietly "installing deworldsg_ros" pip_install --no-deps --no-build-isolation --force-reinstall \
    "$stamps/source"
  rm -rf "$stamps/source"
  echo "$expected" >"$stamps/project"
}

# Each process of the graph takes 32 MB of shared memory for images (config/fastdds.xml).
check_shared_memory() {
  local free_mb
  free_mb=$(df -Pm /dev/shm 2>/dev/null | awk 'NR == 2 { print $4 }')
  if [ "${free_mb:-0}" -lt 256 ]; then
    say "  /dev/shm has ${free_mb:-no} MB free, less than the 256 MB that lose no image;" \
      "in a container: docker run --shm-size=512m"
  fi
}

bootstrap() {
  local profile=$1 ros=wheels
  [ "$(uname -s)" = Linux ] || fail "needs Linux; this is $(uname -s)"
  unset VIRTUAL_ENV PYTHONHOME
  if jazzy_is_sourced; then
    ros=sourced
  else
    [ "$(uname -m)" = x86_64 ] || fail "ROS 2 wheels exist for x86_64 only and this is $(uname -m):" \
      "install ROS 2 Jazzy and source its setup.bash first"
    forget_other_ros
  fi
  if [ -d "$venv" ] && [ ! -d "$stamps" ]; then
    fail ".venv exists and was not made by this script; move it away"
  fi
  mkdir -p "$stamps"
  if command -v flock >/dev/null; then
    exec 9>"$stamps/lock"
    flock -n 9 || { say "  waiting for another start in this checkout …" && flock 9; }
  fi
  make_venv "$ros"
  install_requirements "$ros" "$profile"
  install_project
  exec 9>&-
  check_shared_memory

  export VIRTUAL_ENV="$venv" PATH="$venv/bin:$PATH"
  export AMENT_PREFIX_PATH="$venv${AMENT_PREFIX_PATH:+:$AMENT_PREFIX_PATH}"
  export ROS_AUTOMATIC_DISCOVERY_RANGE="${ROS_AUTOMATIC_DISCOVERY_RANGE:-LOCALHOST}"
  export FASTRTPS_DEFAULT_PROFILES_FILE="${FASTRTPS_DEFAULT_PROFILES_FILE:-$venv/share/deworldsg_ros/config/fastdds.xml}"
}
