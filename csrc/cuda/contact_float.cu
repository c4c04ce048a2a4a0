#include "contact_lag.cuh"

DIFFVBD_INSTANTIATE_CONTACT(float)
DIFFVBD_INSTANTIATE_LAG(float)
