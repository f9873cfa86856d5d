/* calibration of the unit $serial_number, made by gradcal
$remarks * measured = input + sum of map(T) * signals, solved for the inputs; frame: $frame
 * temperature in degC, rates in rad/s, specific force in m/s^2; x, y, z. Beyond its range the values at the
 * edge hold. Channels that the calibration lacks stay unchanged.
 */
#ifndef GRADCAL_UNIT_CALIBRATION_H
#define GRADCAL_UNIT_CALIBRATION_H

struct gradcal_term {
    int of;                /* 0-2: gyro x, y, z; 3-5: accelerometer x, y, z */
    int signal[3];         /* factors: numbered likewise; 6: none; 8 more: its magnitude */
    float t_centre, t_inverse;   /* degC, 1/K */
    float w_centre, w_inverse;   /* rad/s, s/rad: of the gyro's own rate */
    int t_count, w_count;
    const float *c;        /* SI; powers of temperature slow, of rate fast */
};

$arrays

#define GRADCAL_TERMS $count
static const struct gradcal_term gradcal_terms[GRADCAL_TERMS] = {
$rows
};

/* of the linear part at the middle of the temperatures */
static const float gradcal_inverse[6][6] = {
$inverse
};

#define GRADCAL_T_MIN $t_min
#define GRADCAL_T_MAX $t_max
#define GRADCAL_W_MIN $w_min
#define GRADCAL_W_MAX $w_max

static inline float gradcal_clip(float x, float low, float high)
{
    return x < low ? low : (x > high ? high : x);
}

/* Corrects one reading: rates x, y, z, then specific forces x, y, z; `out` must not be `raw`. */
static inline void gradcal_correct(float temperature, const float raw[6], float out[6])
{
    const float t = gradcal_clip(temperature, GRADCAL_T_MIN, GRADCAL_T_MAX);
    for (int k = 0; k < 6; k++) out[k] = 0.0f;
    for (int round = 0; round < $rounds; round++) {
        float error[6] = {0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f};
        for (int k = 0; k < GRADCAL_TERMS; k++) {
            const struct gradcal_term *a = &gradcal_terms[k];
            const float x = (t - a->t_centre) * a->t_inverse;
            const float own = gradcal_clip(out[a->of], GRADCAL_W_MIN, GRADCAL_W_MAX);
            const float w = (own - a->w_centre) * a->w_inverse;
            float value = 0.0f;
            for (int i = a->t_count - 1; i >= 0; i--) {
                float row = 0.0f;
                for (int j = a->w_count - 1; j >= 0; j--) row = row * w + a->c[i * a->w_count + j];
                value = value * x + row;
            }
            for (int j = 0; j < 3; j++) {
                const int s = a->signal[j] & 7;
                if (s == 6) continue;
                value *= (a->signal[j] & 8) && out[s] < 0.0f ? -out[s] : out[s];
            }
            error[a->of] += value;
        }
        for (int k = 0; k < 6; k++) error[k] = raw[k] - out[k] - error[k];
        for (int k = 0; k < 6; k++) {
            for (int j = 0; j < 6; j++) out[k] += gradcal_inverse[k][j] * error[j];
        }
    }
}

/* self-test: gradcal_correct(GRADCAL_TEST_T, raw, out) must give these within GRADCAL_TEST_TOLERANCE */
#define GRADCAL_TEST_T $temperature
static const float gradcal_test_raw[6] = {$raw};
static const float gradcal_test_out[6] = {$out};
#define GRADCAL_TEST_TOLERANCE $tolerance

#endif
