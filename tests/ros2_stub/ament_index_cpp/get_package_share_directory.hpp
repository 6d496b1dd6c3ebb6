// As much of ament_index_cpp as a generated node uses: packages are installed where AMENT_PREFIX_PATH says.
#pragma once

#include <cstdlib>
#include <string>

namespace ament_index_cpp {

inline std::string get_package_share_directory(const std::string &package) {
  const char *prefix = std::getenv("AMENT_PREFIX_PATH");
  return std::string(prefix ? prefix : "") + "/share/" + package;
}

}  // namespace ament_index_cpp
