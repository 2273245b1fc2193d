// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// What Python sees of the engine: a C ABI, called through ctypes.

#define CLOTH_PUBLIC extern "C" __attribute__((visibility("default")))

CLOTH_PUBLIC int cloth_engine_abi() { return 0; }

CLOTH_PUBLIC const char* cloth_engine_name()
{
    static_assert(CLOTH_VECTOR_BYTES == 16 || CLOTH_VECTOR_BYTES == 32 || CLOTH_VECTOR_BYTES == 64);
    return CLOTH_VECTOR_BYTES == 64 ? "64 bytes" : CLOTH_VECTOR_BYTES == 32 ? "32 bytes" : "16 bytes";
}
