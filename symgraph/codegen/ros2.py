"""A ROS 2 package around a generated planner: a service that plans, and the node that offers it."""

from __future__ import annotations

import keyword
from collections.abc import Iterable, Iterator

from symgraph.codegen.description import ActionSlot, Description, SelectionSlot, StateSlot, c_names
from symgraph.codegen.header import STATUSES

# What a call of the service can come to; the other statuses are of mistakes that the node does not make.
MET = {
    "OK": "the search came to its end",
    "TIME_LIMIT": "time is over: the plan is the best so far",
    "INTERRUPTED": "the node is told to end: the plan is the best so far",
    "NO_PLAN": "no point with a finite value was found",
    "STATE_NOT_FINITE": "a number of the state is not finite",
    "COVARIANCE": "a covariance is not symmetric, or none, or has another number of elements",
    "OPTION": "the time limit is negative, or no number",
}

# Every service of a planner has these fields.
ASKED, ANSWERED = ("seed", "time_limit"), ("value", "violation", "status", "message")

# Keywords of OMG IDL 4.2, which services pass through, that are none of C++ or Python.
_IDL_WORDS = frozenset(
    """
    abstract alias any attribute bitfield bitmask bitset boolean component connector consumes context custom emits
    eventtype exception factory finder fixed getraises getter home inout int16 int32 int64 int8 interface local
    manages map mirrorport module multiple native object octet oneway out port porttype primarykey provides publishes
    raises readonly sequence setraises setter string supports typeprefix uint16 uint32 uint64 uint8 uses valuebase
    valuetype wchar wstring
    """.split()  # noqa: SIM905 a list of them would be a page
)


def ros2_files(d: Description) -> dict[str, str]:
    """Return {path in the package: text} of a package for Humble and later, complete with what `copies` names."""
    return {
        "package.xml": _manifest(d),
        "CMakeLists.txt": "\n".join(_build_file(d)) + "\n",
        "srv/Plan.srv": "\n".join(_service(d)) + "\n",
        f"src/{d.name}_node.cpp": "\n".join(_node(d)) + "\n",
    }


def copies(d: Description) -> dict[str, str]:
    """Return {name of an exported file: its path in the package}."""
    # Header and source stand beside the node: no path of includes is needed, on which a header may hide another.
    made = {f"{d.name}.{end}": f"src/{d.name}.{end}" for end in ("h", "c")}
    if d.weights_in == "file":
        made[f"{d.name}.weights"] = f"weights/{d.name}.weights"
    return made


def package_name(d: Description) -> str:
    """Return the name of package and node; it is a namespace in C++, so none that the planner's header takes."""
    return f"{_plain(d.name)}_planning"


def _plain(name: str) -> str:
    """Return a C identifier by the rule of packages and fields: lower case, no underscores at the ends or in a row."""
    return c_names([name.lower()])[0].rstrip("_")


def _fields(names: Iterable[str], reserved: Iterable[str]) -> list[str]:
    """Return different names of fields, none of them reserved or a keyword in a language that fields pass through."""
    made: dict[str, None] = {}
    for name in names:
        plain = _plain(name)
        if plain in reserved or plain in _IDL_WORDS or keyword.iskeyword(plain) or c_names([plain]) != [plain]:
            plain += "_slot"
        field, number = plain, 2
        while field in made:
            field, number = f"{plain}_{number}", number + 1
        made[field] = None
    return list(made)


def _asked(d: Description) -> list[tuple[StateSlot, str, str]]:
    """Return the given states with the fields of mean and covariance, the latter "" where there is none."""
    means = _fields([slot.name for slot in d.given], ASKED)
    uncertain = [f"{mean}_covariance" for slot, mean in zip(d.given, means, strict=True) if slot.uncertain]
    covariances = iter(_fields(uncertain, (*ASKED, *means)))
    return [
        (slot, mean, next(covariances) if slot.uncertain else "") for slot, mean in zip(d.given, means, strict=True)
    ]


def _answered(d: Description) -> tuple[list[tuple[ActionSlot, str]], list[tuple[SelectionSlot, str]]]:
    """Return actions and selections with their fields."""
    fields = _fields([*(slot.name for slot in d.actions), *(slot.name for slot in d.selections)], ANSWERED)
    count = len(d.actions)
    return (
        list(zip(d.actions, fields[:count], strict=True)),
        list(zip(d.selections, fields[count:], strict=True)),
    )


# package.xml and CMakeLists.txt


def _manifest(d: Description) -> str:
    file = "\n  <depend>ament_index_cpp</depend>\n  <depend>rcl_interfaces</depend>" if d.weights_in == "file" else ""
    return f"""\
<?xml version="1.0"?>
<?xml-model href="http://download.ros.org/schema/package_format3.xsd" schematypens="http://www.w3.org/2001/XMLSchema"?>
<package format="3">
  <name>{package_name(d)}</name>
  <version>1.0.0</version>
  <description>The planner {d.name} as a service. Generated by symgraph from a task graph.</description>
  <maintainer email="maintainer@example.com">put your name here</maintainer>
  <license>TODO: put your licence here</license>

  <buildtool_depend>ament_cmake</buildtool_depend>
  <buildtool_depend>rosidl_default_generators</buildtool_depend>
  <depend>rclcpp</depend>{file}
  <exec_depend>rosidl_default_runtime</exec_depend>
  <member_of_group>rosidl_interface_packages</member_of_group>

  <export>
    <build_type>ament_cmake</build_type>
  </export>
</package>
"""


def _build_file(d: Description) -> Iterator[str]:
    file = d.weights_in == "file"
    yield "cmake_minimum_required(VERSION 3.16)"
    yield f"project({package_name(d)} LANGUAGES C CXX)"
    yield ""
    yield "# colcon chooses no type of build, and without optimization a search takes many times as long."
    yield "if(NOT CMAKE_BUILD_TYPE AND NOT CMAKE_CONFIGURATION_TYPES)"
    yield "  set(CMAKE_BUILD_TYPE Release)"
    yield "endif()"
    yield ""
    for package in ("ament_cmake", *["ament_index_cpp"] * file, "rclcpp", "rosidl_default_generators"):
        yield f"find_package({package} REQUIRED)"
    yield ""
    yield 'rosidl_generate_interfaces(${PROJECT_NAME} "srv/Plan.srv")'
    yield "rosidl_get_typesupport_target(interfaces ${PROJECT_NAME} rosidl_typesupport_cpp)"
    yield "ament_export_dependencies(rosidl_default_runtime)"
    yield ""
    yield f"add_library(${{PROJECT_NAME}}_core STATIC src/{d.name}.c)"
    yield "set_target_properties(${PROJECT_NAME}_core PROPERTIES C_STANDARD 99 C_STANDARD_REQUIRED ON)"
    yield "if(UNIX)"
    yield "  target_link_libraries(${PROJECT_NAME}_core PUBLIC m)"
    yield "endif()"
    yield ""
    index = " ament_index_cpp::ament_index_cpp" if file else ""
    yield f"add_executable({d.name}_node src/{d.name}_node.cpp)"
    yield f"target_compile_features({d.name}_node PRIVATE cxx_std_17)"
    yield f"target_link_libraries({d.name}_node PRIVATE ${{PROJECT_NAME}}_core rclcpp::rclcpp{index}"
    yield '                      "${interfaces}")'
    yield f"install(TARGETS {d.name}_node DESTINATION lib/${{PROJECT_NAME}})"
    if file:
        yield f"install(FILES weights/{d.name}.weights DESTINATION share/${{PROJECT_NAME}})"
    yield ""
    yield "ament_package()"


# Plan.srv


def _service(d: Description) -> Iterator[str]:
    yield f"# The planner {d.name}: from a state to the actions and choices with the highest expected reward."
    yield "# Generated by symgraph from a task graph: change the graph, not this file."
    yield ""
    asked = _asked(d)
    for slot, field, _ in asked:
        yield _line(_kind(slot.size), field, _label(slot.label, field), slot.unit)
    for slot, _, covariance in asked:
        if covariance:
            unit = f"({slot.unit})^2" if slot.unit else None
            many = f"{slot.size**2} numbers, column by column" if slot.size > 1 else "one number"
            yield _line("float64[]", covariance, f"of {slot.label}: {many}; none: it is exact", unit)
    yield _line("uint64", "seed", "of all that is random; 0: as the node's parameter says")
    yield _line("float64", "time_limit", "the best plan until then is returned; 0: as the node's parameter says", "s")
    yield "---"
    codes = {name: code for name, code, _ in STATUSES}
    for name, told in MET.items():
        yield _line("int32", f"STATUS_{name}={codes[name]}", told)
    yield ""
    actions, selections = _answered(d)
    yield "# The plan; where there is none, numbers are NaN and strings are empty."
    for action, field in actions:
        yield _line(_kind(action.size), field, _label(action.label, field), action.unit)
    for selection, field in selections:
        label, choices = _label(selection.label, field), " or ".join(selection.choices)
        yield _line("string", field, f"{label}: {choices}" if label else choices)
    yield _line("float64", "value", "expected sum of rewards" + (f", less {d.risk:g} deviations" if d.risk else ""))
    yield _line("float64", "violation", "the largest breach of a requirement, in the unit of its model; 0: all are met")
    yield ""
    yield _line("int32", "status", "from 0 on there is a plan, below 0 there is none")
    yield _line("string", "message", "the status in words")


def _kind(size: int) -> str:
    return f"float64[{size}]" if size > 1 else "float64"


def _label(label: str, field: str) -> str:
    return "" if label == field else label


def _line(kind: str, field: str, told: str, unit: str | None = None) -> str:
    # To rosidl, what stands in brackets is the unit: nothing else may. It reads files in the locale: ASCII suits all.
    plain = str.maketrans({"[": "(", "]": ")", '"': "'", "\\": "/", "\n": " "})
    unit, told = (text.translate(plain).encode("ascii", "replace").decode() for text in (unit or "", told))
    comment = " ".join(part for part in (f"[{unit}]" if unit else "", told) if part)
    return f"{kind} {field}" + (f"  # {comment}" if comment else "")


# The node


def _node(d: Description) -> Iterator[str]:
    file = d.weights_in == "file"
    package, capitals = package_name(d), d.name.upper()
    yield f"// Offers the planner {d.name} as the service ~/plan."
    yield "// Generated by symgraph from a task graph: change the graph, not this file."
    for include in ("algorithm", "array", "chrono", "cstddef", "cstdint", "exception", *["fstream"] * file, "limits"):
        yield f"#include <{include}>"
    for include in ("memory", "stdexcept", "string", "vector"):
        yield f"#include <{include}>"
    yield ""
    if file:
        yield '#include "ament_index_cpp/get_package_share_directory.hpp"'
        yield '#include "rcl_interfaces/msg/parameter_descriptor.hpp"'
    yield '#include "rclcpp/rclcpp.hpp"'
    yield ""
    yield f'#include "{d.name}.h"'
    yield f'#include "{package}/srv/plan.hpp"'
    yield ""
    yield "namespace {"
    yield ""
    yield f"using Plan = {package}::srv::Plan;"
    yield ""
    for slot in d.selections:
        listed = ", ".join(map(_literal, slot.choices))
        yield f"constexpr const char *{slot.name}_choices[] = {{{listed}}};"
    if d.selections:
        yield ""
    yield "class Planner : public rclcpp::Node {"
    yield " public:"
    yield f'  Planner() : rclcpp::Node("{package}") {{'
    yield '    declare_parameter<double>("time_limit", 0.0);'
    yield '    declare_parameter<std::int64_t>("seed", 0);'
    yield from _begin_with_file(d) if file else _begin(d)
    yield "    // Callbacks of the node's own group exclude each other: one planner is enough."
    yield '    service_ = create_service<Plan>("~/plan", [this](const std::shared_ptr<Plan::Request> request,'
    yield "                                                     std::shared_ptr<Plan::Response> response) {"
    yield "      answer(*request, *response);"
    yield "    });"
    yield "  }"
    yield ""
    yield " private:"
    yield from _answer(d)
    yield ""
    yield from _search(d)
    yield ""
    if any(covariance for _, _, covariance in _asked(d)):
        yield "  // Copy a covariance; none says that the state is exact."
        yield "  static bool take(const std::vector<double> &given, double *covariance, std::size_t count) {"
        yield "    if (!given.empty() && given.size() != count) return false;"
        yield "    std::copy(given.begin(), given.end(), covariance);"
        yield "    return true;"
        yield "  }"
        yield ""
    yield f"  alignas(std::max_align_t) std::array<unsigned char, {capitals}_MEMORY> memory_;"
    if file:
        yield "  // One byte more than there are weights, to notice a file that is too long."
        yield f"  alignas(std::max_align_t) std::array<unsigned char, {capitals}_WEIGHTS + 1> weights_;"
    yield f"  {d.name}_planner *planner_ = nullptr;"
    yield "  rclcpp::Service<Plan>::SharedPtr service_;"
    yield "};"
    yield ""
    yield "}  // namespace"
    yield ""
    yield "int main(int count, char **arguments) {"
    yield "  rclcpp::init(count, arguments);"
    yield "  try {"
    yield "    rclcpp::spin(std::make_shared<Planner>());"
    yield "  } catch (const std::exception &error) {"
    yield f'    RCLCPP_FATAL(rclcpp::get_logger("{package}"), "%s", error.what());'
    yield "    rclcpp::shutdown();"
    yield "    return 1;"
    yield "  }"
    yield "  rclcpp::shutdown();"
    yield "  return 0;"
    yield "}"


def _begin(d: Description) -> Iterator[str]:
    yield f"    const int status = {d.name}_begin(memory_.data(), memory_.size(), &planner_);"
    yield f"    if (status != {d.name.upper()}_OK) throw std::runtime_error({d.name}_message(status));"


def _begin_with_file(d: Description) -> Iterator[str]:
    yield "    rcl_interfaces::msg::ParameterDescriptor descriptor;"
    yield "    descriptor.read_only = true;  // the file is read here and never again"
    yield "    const auto path = declare_parameter<std::string>("
    yield f'        "weights_file", ament_index_cpp::get_package_share_directory("{package_name(d)}") +'
    yield f'                            "/{d.name}.weights", descriptor);'
    yield "    std::ifstream file(path, std::ios::binary);"
    yield '    if (!file) throw std::runtime_error(path + " cannot be read: set the parameter weights_file");'
    yield "    file.read(reinterpret_cast<char *>(weights_.data()), static_cast<std::streamsize>(weights_.size()));"
    yield f"    const int status = {d.name}_begin(memory_.data(), memory_.size(), weights_.data(),"
    yield f"    {' ' * len(f'const int status = {d.name}_begin(')}static_cast<std::size_t>(file.gcount()), &planner_);"
    yield f'    if (status != {d.name.upper()}_OK) throw std::runtime_error(path + ": " + {d.name}_message(status));'


def _answer(d: Description) -> Iterator[str]:
    actions, selections = _answered(d)
    yield "  void answer(const Plan::Request &request, Plan::Response &response) {"
    yield f"    {d.name}_plan plan{{}};"
    yield "    response.status = search(request, plan);"
    yield f"    response.message = {d.name}_message(response.status);"
    yield f"    if (response.status < {d.name.upper()}_OK) {{"
    yield "      // A robot that overlooks the status must not move by zeros."
    yield "      constexpr double nothing = std::numeric_limits<double>::quiet_NaN();"
    for action, field in actions:
        yield f"      response.{field}{'.fill(nothing)' if action.size > 1 else ' = nothing'};"
    yield "      response.value = response.violation = nothing;"
    yield "      return;"
    yield "    }"
    for action, field in actions:
        source = f"plan.actions.{action.name}"
        if action.size > 1:
            yield f"    std::copy_n({source}, {action.size}, response.{field}.begin());"
        else:
            yield f"    response.{field} = {source};"
    for selection, field in selections:
        yield f"    response.{field} = {selection.name}_choices[plan.selections.{selection.name}];"
    yield "    response.value = plan.value;"
    yield "    response.violation = plan.violation;"
    yield "  }"


def _search(d: Description) -> Iterator[str]:
    asked = _asked(d)
    yield f"  int search(const Plan::Request &request, {d.name}_plan &plan) {{"
    yield f"    {d.name}_state state{{}};"
    yield f"    {d.name}_options options{{}};"
    for slot, field, _ in asked:
        if slot.size > 1:
            yield f"    std::copy_n(request.{field}.begin(), {slot.size}, state.{slot.name});"
        else:
            yield f"    state.{slot.name} = request.{field};"
    for slot, _, covariance in asked:
        if covariance:
            target = f"{'&' if slot.size == 1 else ''}state.{slot.name}_covariance"
            wrong = f"return {d.name.upper()}_COVARIANCE"
            yield f"    if (!take(request.{covariance}, {target}, {slot.size**2})) {wrong};"
    yield "    // Parameters are read each time: they may be set while the node runs."
    yield '    const auto seed = static_cast<std::uint64_t>(get_parameter("seed").as_int());'
    yield '    const double time_limit = get_parameter("time_limit").as_double();'
    yield "    options.seed = request.seed != 0 ? request.seed : seed;"
    yield "    options.seconds = request.time_limit != 0 ? request.time_limit : time_limit;"
    yield "    options.clock = [](void *) noexcept {"
    yield "      return std::chrono::duration<double>(std::chrono::steady_clock::now().time_since_epoch()).count();"
    yield "    };"
    yield "    // Ctrl-C ends a search that has no limit."
    yield f"    options.progress = [](void *, const {d.name}_plan *) noexcept {{ return rclcpp::ok() ? 0 : 1; }};"
    yield f"    return {d.name}_solve(planner_, &state, &options, &plan);"
    yield "  }"


def _literal(text: str) -> str:
    """Return text as a string in C++."""
    escaped = text.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n").replace("??", "?\\?")
    return f'"{escaped}"'
