#include "contact_lag.cuh"

DIFFVBD_INSTANTIATE_CONTACT(double)
DIFFVBD_INSTANTIATE_LAG(double)
