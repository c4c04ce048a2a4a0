// Groups of bodies whose rigid motions are solved for together (docs/method.md, section 18): those that touch, unless
// they are too many: then each of them is left alone. Scenes of few bodies are one group.
#pragma once

#include <cstdint>

#include "../core/vec.h"

namespace diffvbd::contact {

constexpr int kUnknowns = 6;                // of a body: a turn and a shift
constexpr int kFew = 3;                     // bodies of scenes that are one group
constexpr int kMostCoupled = 64;            // bodies of a group
constexpr int64_t kGroupMemory = 32 << 10;  // bodies of a scene times those of a group at most: room for matrices
constexpr int kGroupRows = 4;               // member, first, rank and count
constexpr int32_t kLeft = -1;               // as the count of a group: a body of too many that touch

// Bodies of a group at most.
DIFFVBD_FN int64_t most_grouped(int64_t bodies) {
  if (bodies == 0) return 0;
  const int64_t most = kGroupMemory / bodies < kMostCoupled ? kGroupMemory / bodies : kMostCoupled;
  return most < 1 ? 1 : most < bodies ? most : bodies;
}

// Those of a scene. Bodies have places, those of a group in a row: of no more than kFew in the order of their numbers,
// else in that of their elimination, if they are solved for.
struct Groups {
  int32_t bodies;
  int64_t room;  // bodies of a group that the memory of its matrix has room for: none is solved for that has more
  const int32_t* rows;  // [4, bodies], or null: all are one group

  DIFFVBD_FN int32_t member(int32_t place) const { return rows ? rows[place] : place; }
  DIFFVBD_FN int32_t first(int32_t body) const { return rows ? rows[bodies + body] : 0; }
  DIFFVBD_FN int32_t rank(int32_t body) const { return rows ? rows[2 * bodies + body] : body; }
  // Of the group that begins at a place, or 0.
  DIFFVBD_FN int32_t count(int32_t place) const {
    if (!rows) return place == 0 ? bodies : 0;
    return is_left(place) ? 1 : rows[3 * bodies + place];
  }
  // Whether the body there is alone because those that touch are too many.
  DIFFVBD_FN bool is_left(int32_t place) const { return rows && rows[3 * bodies + place] == kLeft; }
  DIFFVBD_FN bool joined(int32_t a, int32_t b) const { return first(a) == first(b); }
  // Where in the memory of its scene the matrix of the group is that begins at a place.
  DIFFVBD_FN int64_t matrix(int32_t place) const { return rows ? kUnknowns * kUnknowns * room * place : 0; }
};

}  // namespace diffvbd::contact
