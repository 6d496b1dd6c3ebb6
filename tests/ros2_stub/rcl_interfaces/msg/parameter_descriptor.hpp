// As much of rcl_interfaces as a generated node uses.
#pragma once

namespace rcl_interfaces::msg {

struct ParameterDescriptor {
  bool read_only = false;
};

}  // namespace rcl_interfaces::msg
