/* gyro calibration of $serial_number, made by gradcal
$remarks * measured = (1 + M(T, rate)) * rate + B(T), on each axis alone, in the sensor's own frame:
 * $axes
 * temperature in degC, rates in rad/s. Outside its range the calibration holds its value at the edge.
 */
#ifndef GRADCAL_CALIBRATION_H
#define GRADCAL_CALIBRATION_H

#define GRADCAL_AXES $count

struct gradcal_axis {
    float t_min, t_max;          /* degC */
    float w_min, w_max;          /* rad/s */
    float bt_centre, bt_scale;   /* degC, K */
    int b_count;
    const float *b;              /* rad/s, powers of (T - bt_centre)/bt_scale */
    float mt_centre, mt_scale;   /* degC, K */
    float mw_centre, mw_scale;   /* rad/s */
    int mt_count, mw_count;
    const float *m;              /* ratio; powers of temperature slow, of rate fast */
};

$arrays
static const struct gradcal_axis gradcal_axes[GRADCAL_AXES] = {
$rows
};

static inline float gradcal_clip(float x, float low, float high)
{
    return x < low ? low : (x > high ? high : x);
}

/* Corrects one reading of all axes; `out` may be `raw`. */
static inline void gradcal_correct(float temperature, const float raw[GRADCAL_AXES], float out[GRADCAL_AXES])
{
    for (int k = 0; k < GRADCAL_AXES; k++) {
        const struct gradcal_axis *a = &gradcal_axes[k];
        const float t = gradcal_clip(temperature, a->t_min, a->t_max);
        const float tb = (t - a->bt_centre) / a->bt_scale;
        const float tm = (t - a->mt_centre) / a->mt_scale;
        float bias = 0.0f;
        for (int i = a->b_count - 1; i >= 0; i--) bias = bias * tb + a->b[i];
        const float unbiased = raw[k] - bias;
        float rate = unbiased;
        for (int round = 0; round < $rounds; round++) {
            const float w = (gradcal_clip(rate, a->w_min, a->w_max) - a->mw_centre) / a->mw_scale;
            float scale = 0.0f;
            for (int i = a->mt_count - 1; i >= 0; i--) {
                float row = 0.0f;
                for (int j = a->mw_count - 1; j >= 0; j--) row = row * w + a->m[i * a->mw_count + j];
                scale = scale * tm + row;
            }
            rate = unbiased / (1.0f + scale);
        }
        out[k] = rate;
    }
}

/* self-test: gradcal_correct(GRADCAL_TEST_T, raw, out) must give these within GRADCAL_TEST_TOLERANCE */
#define GRADCAL_TEST_T $temperature
static const float gradcal_test_raw[GRADCAL_AXES] = {$raw};
static const float gradcal_test_out[GRADCAL_AXES] = {$out};
#define GRADCAL_TEST_TOLERANCE $tolerance

#endif
