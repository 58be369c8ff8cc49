/*
 * Reads samples and writes estimates: cc -std=c99 -O2 NAME.c NAME_main.c -lm && ./a.out < steps.txt
 *
 * The first line of steps.txt holds the first sample, OUTPUTS. Every further line holds
// if inputs
 * the input held since the last sample, INPUTS, and then the next sample.
// end inputs
// if autonomous
 * the next sample.
// end autonomous
// if tracks
 * Write nan for a missing output. The first sample must be complete.
// end tracks
 */
#include <stdio.h>

#include "NAME.h"

static int read_numbers(NAME_real *values, int count)
{
    for (int i = 0; i < count; i++) {
        double value;
        int found = scanf("%lf", &value);
        if (found != 1)
            return found == EOF && i == 0 ? EOF : 0;
        values[i] = (NAME_real)value;
    }
    return 1;
}

static void write_numbers(const NAME_real *values, int count)
{
    for (int i = 0; i < count; i++)
        printf("%.DIGITSg%c", (double)values[i], i + 1 < count ? ' ' : '\n');
}

int main(void)
{
    NAME_observer observer;
    NAME_real line[MACRO_NU + MACRO_NY], x_hat[MACRO_NX];
    int found = read_numbers(line, MACRO_NY);
    if (found == 1) {
        NAME_reset(&observer, line);
        NAME_estimate(&observer, x_hat);
        write_numbers(x_hat, MACRO_NX);
    }
    while (found == 1 && (found = read_numbers(line, MACRO_NU + MACRO_NY)) == 1) {
// if inputs
        NAME_step(&observer, line + MACRO_NU, line, x_hat);
// end inputs
// if autonomous
        NAME_step(&observer, line, x_hat);
// end autonomous
        write_numbers(x_hat, MACRO_NX);
    }
    if (found != EOF)
        fprintf(stderr, "a line has too few numbers, or an invalid one\n");
    return found != EOF;
}
