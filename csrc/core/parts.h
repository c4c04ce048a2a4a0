// One piece of memory for many arrays.
#pragma once

#include <cstddef>
#include <cstdint>

namespace diffvbd {

// Hands out the parts of a workspace; without memory it counts their bytes.
template <size_t alignment = 256>
struct Parts {
  unsigned char* memory;
  size_t bytes = 0;
  explicit Parts(void* workspace) : memory(static_cast<unsigned char*>(workspace)) {}
  template <class U>
  void operator()(U*& pointer, int64_t items) {
    pointer = reinterpret_cast<U*>(memory + bytes);
    bytes += (items * sizeof(U) + alignment - 1) / alignment * alignment;
  }
};

}  // namespace diffvbd
