// As much of rclcpp as a generated node uses. What comes over the network there comes from standard input here: `spin`
// reads requests, a field a line and an empty line at the end, hands each to the callback and prints the response
// alike. The line "shutdown" is Ctrl-C during the request that follows.
#pragma once

#include <array>
#include <cstdint>
#include <cstdio>
#include <functional>
#include <iostream>
#include <map>
#include <memory>
#include <sstream>
#include <stdexcept>
#include <string>
#include <variant>
#include <vector>

#include "rcl_interfaces/msg/parameter_descriptor.hpp"

#define RCLCPP_FATAL(logger, ...) ((logger).print(), std::fprintf(stderr, __VA_ARGS__), std::fputc('\n', stderr))

namespace rclcpp {

struct Process {
  std::map<std::string, std::string> parameters;  // as the command line says
  bool running = false;
};

inline Process &process() {
  static Process one;
  return one;
}

inline void init(int count, char **arguments) {
  process().running = true;
  for (int i = 1; i + 1 < count; ++i) {
    const std::string text = arguments[i + 1];
    const auto at = text.find(":=");
    if (std::string(arguments[i]) == "-p") process().parameters[text.substr(0, at)] = text.substr(at + 2);
  }
}

inline bool ok() { return process().running; }

inline bool shutdown() {
  process().running = false;
  return true;
}

struct Logger {
  std::string name;
  void print() const { std::fprintf(stderr, "[%s] ", name.c_str()); }
};

inline Logger get_logger(const std::string &name) { return {name}; }

class Parameter {
 public:
  using Value = std::variant<double, std::int64_t, std::string>;
  Parameter() = default;
  explicit Parameter(Value value) : value_(std::move(value)) {}
  double as_double() const { return std::get<double>(value_); }
  std::int64_t as_int() const { return std::get<std::int64_t>(value_); }

 private:
  Value value_;
};

struct Reader {
  std::map<std::string, std::string> lines;
  template <class T>
  void operator()(const char *field, T &value) {
    const auto line = lines.find(field);
    if (line == lines.end()) return;
    std::istringstream numbers(line->second);
    take(numbers, value);
    lines.erase(line);
  }

 private:
  static void take(std::istream &from, double &value) {
    std::string word;  // a stream reads no "nan"
    from >> word;
    value = std::stod(word);
  }
  static void take(std::istream &from, std::uint64_t &value) { from >> value; }
  template <std::size_t N>
  static void take(std::istream &from, std::array<double, N> &values) {
    for (double &value : values) take(from, value);
  }
  static void take(std::istream &from, std::vector<double> &values) {
    for (double value; from >> value;) values.push_back(value);
  }
};

struct Printer {
  template <class T>
  void operator()(const char *field, const T &value) {
    std::printf("%s", field);
    put(value);
    std::printf("\n");
  }

 private:
  static void put(double value) { std::printf(" %.17g", value); }
  static void put(std::int32_t value) { std::printf(" %d", static_cast<int>(value)); }
  static void put(const std::string &value) { std::printf(" %s", value.c_str()); }
  template <std::size_t N>
  static void put(const std::array<double, N> &values) {
    for (double value : values) put(value);
  }
};

struct ServiceBase {
  virtual ~ServiceBase() = default;
  virtual void serve(Reader reader) = 0;
};

template <class T>
class Service : public ServiceBase {
 public:
  using SharedPtr = std::shared_ptr<Service<T>>;
  using Callback = std::function<void(std::shared_ptr<typename T::Request>, std::shared_ptr<typename T::Response>)>;
  explicit Service(Callback callback) : callback_(std::move(callback)) {}

  void serve(Reader reader) override {
    auto request = std::make_shared<typename T::Request>();
    auto response = std::make_shared<typename T::Response>();
    request->visit(reader);
    for (const auto &line : reader.lines) throw std::runtime_error("the request has no field " + line.first);
    callback_(request, response);
    response->visit(Printer());
    std::printf("\n");
  }

 private:
  Callback callback_;
};

class Node {
 public:
  explicit Node(const std::string &name) : name_(name) {}
  Node(const Node &) = delete;
  Node &operator=(const Node &) = delete;
  virtual ~Node() = default;

  template <class T>
  T declare_parameter(const std::string &name, const T &otherwise,
                      const rcl_interfaces::msg::ParameterDescriptor & = {}) {
    T value = otherwise;
    const auto given = process().parameters.find(name);
    if (given != process().parameters.end()) std::istringstream(given->second) >> value;
    parameters_[name] = Parameter(value);
    return value;
  }

  Parameter get_parameter(const std::string &name) const { return parameters_.at(name); }

  template <class T>
  typename Service<T>::SharedPtr create_service(const std::string &name, typename Service<T>::Callback callback) {
    if (name != "~/plan") throw std::runtime_error("a service of another name: " + name);
    auto service = std::make_shared<Service<T>>(callback);
    service_ = service;
    return service;
  }

  void serve(const Reader &reader) {
    const auto service = service_.lock();  // as rclcpp, the node does not keep it alive
    if (!service) throw std::runtime_error("nobody keeps the service");
    service->serve(reader);
  }

 private:
  std::string name_;
  std::map<std::string, Parameter> parameters_;
  std::weak_ptr<ServiceBase> service_;
};

inline void spin(const std::shared_ptr<Node> &node) {
  Reader reader;
  for (std::string line; std::getline(std::cin, line);) {
    const auto end = line.find(' ');
    if (line == "shutdown") {
      shutdown();
    } else if (line.empty()) {
      node->serve(reader);
      reader.lines.clear();
    } else {
      reader.lines[line.substr(0, end)] = end == std::string::npos ? "" : line.substr(end + 1);
    }
  }
}

}  // namespace rclcpp
