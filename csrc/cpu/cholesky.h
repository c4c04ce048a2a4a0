// Systems of rigid motions, whose matrices are of blocks of six, one for each two bodies.
#pragma once

#include <cstdint>

namespace diffvbd {

// The Cholesky factor of a matrix of blocks of six, in its lower triangle; what is no number says that it is not
// positive definite. Blocks of zeros are left out: bodies touch few others.
void cholesky(int64_t size, double* a);
// b = factor^-T factor^-1 b
void cholesky_solve(int64_t size, const double* a, double* b);

}  // namespace diffvbd
