# shellcheck shell=bash
# Makes the environment of scripts/demo and scripts/test. Source this file, then call
# `bootstrap run` or `bootstrap test`. It installs the requirements of pyproject.toml and the
# project into .venv, puts .venv/bin first on PATH and sets the ROS variables. Outside the checkout
# it changes only pip's cache.
#
# Each slow step stores the hash of its input in .venv/.bootstrap. A second call without changes
# does no work. A call after an interruption continues where the first one stopped.
#
# With DEWORLDSG_TEST_MODELS set, `bootstrap test` adds torch, and the environment is .venv-models.
# With DEWORLDSG_LOCKED=1 it installs the versions of locks/ instead, and checks their hashes.

root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
venv="$root/.venv${DEWORLDSG_TEST_MODELS:+-models}"
stamps="$venv/.bootstrap"
log="$stamps/log.txt"

say() { printf '%s\n' "$*" >&2; }

fail() {
  printf '%s: %s\n' "${0##*/}" "$*" >&2
  exit 1
}

newest_line() { tail -n 9 "$log" | sed -n '/^WARNING/!{s/^ *//;s/\r//g;h};${g;p}' | cut -c 1-60; }

# quietly LABEL COMMAND...: run the command and show one line, with the newest line of its output.
# Without a terminal, a line every 15 s. Show the whole output only if the command fails.
quietly() {
  local label=$1 began=$SECONDS pid status=0 turn=0 spinner='-\|/' line said=$SECONDS
  shift
  "$@" >"$log" 2>&1 </dev/null 9>&- &
  pid=$!
  trap 'kill "$pid" 2>/dev/null; say; fail "stopped; the next call continues here"' INT TERM
  [ -t 2 ] || say "  $label …"
  while kill -0 "$pid" 2>/dev/null; do
    if [ -t 2 ]; then
      line="  ${spinner:turn % 4:1} $label … $((SECONDS - began)) s  $(newest_line)"
      printf '\r\033[K%s' "${line:0:79}" >&2
      turn=$((turn + 1))
    elif [ $((SECONDS - said)) -ge 15 ]; then
      said=$SECONDS
      say "  $label … $((SECONDS - began)) s  $(newest_line)"
    fi
    sleep 0.3
  done
  [ ! -t 2 ] || printf '\r\033[K' >&2
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
  # The ROS wheels start each interpreter twice to set LD_LIBRARY_PATH, and mark that with
  # _ROS_WHEELS_BOOTSTRAP_COMPLETE. The mark of another environment would keep its LD_LIBRARY_PATH.
  if [ -n "${ROS_DISTRO:-}${_ROS_WHEELS_BOOTSTRAP_COMPLETE:-}" ]; then unset LD_LIBRARY_PATH; fi
  unset _ROS_WHEELS_BOOTSTRAP_COMPLETE ROS_DISTRO ROS_VERSION ROS_PYTHON_VERSION \
    AMENT_PREFIX_PATH COLCON_PREFIX_PATH CMAKE_PREFIX_PATH PYTHONPATH
  export RMW_IMPLEMENTATION=rmw_fastrtps_cpp
}

version_of() { "$1" -I -S -c 'import sys; print("%d.%d" % sys.version_info[:2])' 2>/dev/null; }

# Print the path of a Python 3.10-3.13 that can make virtual environments.
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
  fail "found on PATH: ${seen#, }; expected Python 3.10, 3.11, 3.12 or 3.13 with venv: install one," \
    "or set PYTHON to its path"
}

hash_of() { (cd "$root" && find "$@" -type f ! -name '*.py[cod]' ! -name '*.nb[ic]' -print0) |
  LC_ALL=C sort -z | (cd "$root" && xargs -0 sha256sum) | sha256sum | cut -d ' ' -f 1; }

is_current() { [ "$(cat "$stamps/$1" 2>/dev/null)" = "$2" ]; }

# Make .venv. Make it again if the path of the checkout, the Python or the ROS has changed.
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
# DEWORLDSG_TEST_MODELS set, test includes torch and transformers. A sourced ROS needs no ROS wheels.
# It needs the major version of numpy with which its message types were compiled.
install_requirements() {
  local ros=$1 profile=$2 extras=(build run) arguments=() list expected
  if [ -n "${DEWORLDSG_LOCKED:-}" ]; then
    install_locked "$ros" "$profile"
    return
  fi
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

pip_install_locked() {
  local lock
  for lock in "$@"; do
    pip_install --require-hashes --no-build-isolation -r "$lock" || return
  done
}

# Install the exact files that locks/ names, by their hashes.
install_locked() {
  local ros=$1 profile=$2 version lock expected
  [ "$ros" = wheels ] || fail "ROS 2 is sourced, and the locks contain the wheels of ROS 2:" \
    "unset DEWORLDSG_LOCKED, or start in a shell without a sourced ROS 2"
  [ "$profile" = run ] || [ -z "${DEWORLDSG_TEST_MODELS:-}" ] || fail "the locks contain no torch:" \
    "unset DEWORLDSG_LOCKED or DEWORLDSG_TEST_MODELS"
  version=$(version_of "$venv/bin/python")
  lock="$root/locks/$profile-$version.txt"
  expected=$(sha256sum <"$lock" | cut -d ' ' -f 1)
  is_current "$profile" "$expected" && return
  rm -f "$stamps/$profile"
  # One package has no wheel. What builds it comes first.
  grep -E '^(packaging|setuptools|wheel)==' "$lock" >"$stamps/build.txt"
  quietly "installing locks/${lock##*/}" pip_install_locked "$stamps/build.txt" "$lock"
  echo "$expected" >"$stamps/$profile"
}

# Install the project from a clean copy. An old build/ would install deleted modules again.
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
  # Otherwise the first run would wait for the compiler.
  quietly "compiling the kernels" "$venv/bin/deworldsg" compile
  echo "$expected" >"$stamps/project"
}

# Each node takes 32 MB of shared memory for images (config/fastdds.xml).
check_shared_memory() {
  local free_mb
  free_mb=$(df -Pm /dev/shm 2>/dev/null | awk 'NR == 2 { print $4 }')
  if [ "${free_mb:-0}" -lt 256 ]; then
    say "  /dev/shm has ${free_mb:-0} MB free; images can be lost with less than 256 MB;" \
      "in a container, use docker run --shm-size=512m"
  fi
}

bootstrap() {
  local profile=$1 ros=wheels
  [ "$(uname -s)" = Linux ] || fail "this system is $(uname -s); expected Linux"
  unset VIRTUAL_ENV PYTHONHOME
  if jazzy_is_sourced; then
    ros=sourced
  else
    [ "$(uname -m)" = x86_64 ] || fail "this machine is $(uname -m); ROS 2 wheels need x86_64:" \
      "install ROS 2 Jazzy and source its setup.bash first"
    forget_other_ros
  fi
  if [ -d "$venv" ] && [ ! -d "$stamps" ]; then
    fail "another program made .venv; move it away, then start again"
  fi
  mkdir -p "$stamps"
  if command -v flock >/dev/null; then
    exec 9>"$stamps/lock"
    flock -n 9 || { say "  waiting for another call in this checkout …" && flock 9; }
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
