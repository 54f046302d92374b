// SPDX-License-Identifier: Apache-2.0
// Error codes of the core. Zero is success, errors are negative.
#ifndef SG_ERR_H
#define SG_ERR_H

// cdef begin
enum sg_err {
    SG_OK = 0,
    SG_E_ARG = -1,      // an argument is outside its documented range
    SG_E_RANGE = -2,    // a result saturated; the output holds the saturated value
    SG_E_MAGIC = -3,    // not a stored model
    SG_E_VERSION = -4,  // a stored model of another format version
    SG_E_BOUNDS = -5,   // a length, count or index is out of bounds
    SG_E_CRC = -6,      // a checksum does not match
    SG_E_SHORT = -7,    // the buffer ends before the message does
    SG_E_UNKNOWN = -8,  // a message type this firmware does not have
    SG_E_STATE = -9,    // the request does not fit the present state
    SG_E_BUSY = -10,    // try again: an earlier request is still under way
};
// cdef end

#endif
