#!/usr/bin/env bash
# Installs the programs that the tests drive, where they are missing, from the system's packages
# (apt): a C compiler for the native kernel, Chromium and its driver for tests/extras/browser,
# ffmpeg for tests/extras/video, OpenGL without a display for tests/extras/lab.
set -euo pipefail

packages=()
command -v cc >/dev/null || packages+=(gcc libc6-dev)
command -v chromium >/dev/null || packages+=(chromium)
command -v chromedriver >/dev/null || packages+=(chromium-driver)
command -v ffmpeg >/dev/null || packages+=(ffmpeg)
libraries=$(PATH="$PATH:/sbin:/usr/sbin" ldconfig -p)
[[ $libraries == *libEGL.so.1* ]] || packages+=(libegl1 libegl-mesa0 libgl1-mesa-dri)
[[ $libraries == *libGL.so.1* ]] || packages+=(libgl1)
[[ $libraries == *libGLU.so.1* ]] || packages+=(libglu1-mesa)
if [ ${#packages[@]} -eq 0 ]; then
  exit 0
fi

as_root=()
if [ "$(id -u)" -ne 0 ]; then
  as_root=(sudo)
fi
if ! command -v apt-get >/dev/null || ! command -v "${as_root[0]:-env}" >/dev/null; then
  echo "the tests need programs that are not on the PATH and cannot be installed here:" \
    "${packages[*]} (names of Debian's packages)" >&2
  exit 1
fi
echo "installing with apt-get: ${packages[*]}"
"${as_root[@]}" apt-get update -q
"${as_root[@]}" env DEBIAN_FRONTEND=noninteractive \
  apt-get install -q -y --no-install-recommends "${packages[@]}"
