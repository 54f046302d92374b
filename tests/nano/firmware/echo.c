// SPDX-License-Identifier: Apache-2.0
// Says 'R' and the reset flags the bootloader left, then echoes every byte plus one.
#include "bench.h"

int main(void)
{
    bench_begin();
    bench_put('R');
    for (;;)
        bench_put(bench_get() + 1);
}
