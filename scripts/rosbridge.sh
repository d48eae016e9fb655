#!/usr/bin/env bash
# Makes .rosbridge with a rosbridge server over ROS 1 for the tests: npm's ros2-web-bridge on rosnodejs. Does nothing
# when it is there. roscore and rospy are Debian's; their message definitions lack the package.xml by which rosnodejs
# finds them, so that a copy with an empty one each stands in.
set -euo pipefail
cd "$(dirname "$0")/.."
source=fixtures/rosbridge_real dir=.rosbridge
messages=(actionlib_msgs geometry_msgs nav_msgs rosgraph_msgs sensor_msgs std_msgs std_srvs)
packages=(python3-roslaunch python3-rosmaster python3-rospy)
for name in "${messages[@]}"; do packages+=("ros-${name//_/-}"); done
for name in geometry nav sensor; do packages+=("python3-$name-msgs"); done
command -v node >/dev/null || packages+=(nodejs)
command -v npm >/dev/null || packages+=(npm)
./scripts/system-packages.sh "${packages[@]}" python3-std-srvs
stamp=$dir/.installed
want=$(cat "$0" $source/*.json $source/*.js $source/shim/* | sha256sum)
[ -f "$stamp" ] && [ "$(cat "$stamp")" = "$want" ] && exit 0
echo "Installing a rosbridge server into $dir (once)..."
rm -rf "$dir"
mkdir -p "$dir/share"
cp -r $source/*.json $source/*.js $source/shim "$dir"
(cd "$dir" && npm ci --ignore-scripts --no-audit --no-fund --loglevel=error)
for name in "${messages[@]}"; do
  mkdir "$dir/share/$name"
  echo "<package/>" >"$dir/share/$name/package.xml"
  # Without actions: rosnodejs would find each of their messages twice.
  for kind in msg srv; do
    if [ -d "/usr/share/$name/$kind" ]; then cp -r "/usr/share/$name/$kind" "$dir/share/$name/$kind"; fi
  done
done
(cd "$dir" && CMAKE_PREFIX_PATH=$PWD ROS_PACKAGE_PATH=$PWD/share node messages.js "$PWD/share/gennodejs/ros" >/dev/null)
echo "$want" >"$stamp"
