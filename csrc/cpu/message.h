// Text of an error. Not a stream: streams drag in the locale, which breaks where a toolchain links the C++ runtime
// statically beside torch's own.
#pragma once

#include <cstdio>
#include <string>
#include <type_traits>

namespace diffvbd {

struct Message {
  std::string text;

  Message& operator<<(const char* a) {
    text += a;
    return *this;
  }
  template <class T, std::enable_if_t<std::is_integral_v<T>, int> = 0>
  Message& operator<<(T a) {
    text += std::to_string(a);
    return *this;
  }
  Message& operator<<(double a) {
    char buffer[32];
    std::snprintf(buffer, sizeof buffer, "%g", a);
    text += buffer;
    return *this;
  }
};

}  // namespace diffvbd
